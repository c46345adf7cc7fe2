// The timeline of a log: play, pause, rate, and marks of motions, warnings and errors.
import {button, el, setText, setValueText} from '../dom';
import {clock, figure} from '../units';
import type {Player} from './player';

const RATES = [0.1, 0.25, 0.5, 1, 2, 5, 10, 30];
const STEPS = 10_000;
const MOST_MARKS = 400;

export function bar(player: Player): HTMLElement {
  const {source, story} = player;
  const range = el('input', {
    id: 'scrub',
    attributes: {type: 'range', min: '0', max: String(STEPS), value: '0', 'aria-label': 'time in the log'},
  });
  const marks = el('div', {class: 'marks', id: 'marks'});
  const text = el('output', {id: 'time'});
  const play = button('▶', () => player.play(!player.playing), {class: 'play', id: 'play', title: 'Play (Space)'});
  const rate = el('select', {attributes: {'aria-label': 'rate'}, id: 'rate', title: 'Rate'});
  for (const value of RATES) rate.append(el('option', {text: `${value}×`, attributes: {value: String(value)}}));
  rate.value = '1';
  rate.addEventListener('change', () => (player.rate = Number(rate.value)));
  range.addEventListener('input', () => {
    player.play(false);
    player.seek((Number(range.value) / STEPS) * source.length);
  });
  const step = (seconds: number) => {
    player.play(false);
    player.seek(player.time + seconds);
  };
  window.addEventListener('keydown', (event) => {
    if (event.target instanceof HTMLElement && event.target.closest('input:not([type=range]), select')) return;
    const act = {
      ' ': () => player.play(!player.playing),
      ArrowLeft: () => step(event.shiftKey ? -0.1 : -1),
      ArrowRight: () => step(event.shiftKey ? 0.1 : 1),
      Home: () => step(-Infinity),
      End: () => step(Infinity),
    }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
  const show = () => {
    setText(play, player.playing ? '❚❚' : '▶');
    if (document.activeElement !== range || player.playing) {
      range.value = String(Math.round((player.time / (source.length || 1)) * STEPS));
    }
    setText(text, `${figure(player.time, 2)} / ${figure(source.length, 1)} s`);
    setValueText(range, text.textContent);
    text.title = clock(new Date((source.scene.log.start + player.time) * 1000));
  };
  let drawn = -1;
  const mark = () => {
    const {length} = source;
    if (!length) return;
    drawn = length;
    const place = (t: number) => `${((t / length) * 100).toFixed(3)}%`;
    const events = story.events.filter(({data}) => data.severity !== 'info').slice(0, MOST_MARKS);
    marks.replaceChildren(
      ...story.starts.slice(0, MOST_MARKS).map(({t}) => {
        const own = el('i', {class: 'motion', title: `motion at ${figure(t, 2)} s`});
        own.style.left = place(t);
        return own;
      }),
      ...events.map(({t, data}) => {
        const own = el('i', {
          class: data.severity === 'error' ? 'error' : 'warning',
          title: `${figure(t, 2)} s: ${data.text}`,
          onclick: () => player.seek(t),
        });
        own.style.left = place(t);
        return own;
      }),
    );
  };
  player.onTime.on(() => {
    show();
    if (source.length !== drawn) mark();
  });
  story.changed.on(mark);
  mark();
  show();
  const track = el('div', {class: 'track'}, marks, range);
  return el('div', {class: 'timeline log-bar', id: 'timeline'}, play, track, text, rate);
}
