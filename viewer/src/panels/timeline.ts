// The planned motion as a ghost: play it, or drag it to a time. While the arm moves, it follows the motion.
import type {Context} from '../context';
import {button, el, setClass, setText, setValueText} from '../dom';
import {figure} from '../units';

export function timeline(context: Context): HTMLElement {
  const {flow, view} = context;
  const range = el('input', {
    id: 'scrub',
    attributes: {type: 'range', min: '0', max: '1000', value: '0', 'aria-label': 'time in the plan'},
  });
  const text = el('output');
  const play = button('▶', () => (playing ? halt() : start()), {
    class: 'play',
    title: 'Plays the planned motion; moves nothing',
  });
  const label = el('span', {class: 'label', text: 'Plan'});
  const element = el('div', {class: 'timeline hidden', id: 'timeline'}, label, play, range, text);
  let playing = false;
  let time = 0;
  let shown: object | null = null;

  const end = () => flow.preview?.summary.duration ?? 0;
  const show = () => {
    range.value = String(end() ? Math.round((time / end()) * 1000) : 0);
    setText(text, `${figure(time, 1)} / ${figure(end(), 1)} s`);
    setValueText(range, text.textContent);
    view.showPlan(flow.preview, time);
  };
  const halt = () => {
    playing = false;
    setText(play, '▶');
  };
  const start = () => {
    if (!flow.preview) return;
    if (time >= end()) time = 0;
    playing = true;
    setText(play, '❚❚');
    let last = performance.now();
    const step = (now: number) => {
      if (!playing || !flow.preview) return;
      time = Math.min(end(), time + Math.max(0, now - last) / 1000);
      last = now;
      show();
      if (time >= end()) halt();
      else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  };
  range.addEventListener('input', () => {
    halt();
    time = (Number(range.value) / 1000) * end();
    show();
  });
  flow.onPlay.on(() => {
    time = 0;
    halt();
    start();
  });
  flow.changed.on(() => {
    const {preview, stage} = flow;
    const visible = preview !== null && (stage === 'planned' || stage === 'executing');
    setClass(element, 'hidden', !visible);
    play.disabled = range.disabled = stage === 'executing';
    setText(label, stage === 'executing' ? 'Motion' : 'Plan');
    if (visible && preview !== shown) {
      shown = preview;
      halt();
      time = end();
      view.showPlanLine(preview);
      show();
    } else if (!visible && shown) {
      shown = null;
      halt();
      view.showPlanLine(null);
      view.showPlan(null, 0);
    }
    if (stage === 'executing' && preview) {
      halt();
      time = end() * (flow.motion?.progress ?? 0);
      range.value = String(Math.round((flow.motion?.progress ?? 0) * 1000));
      setText(text, `${figure(time, 1)} / ${figure(end(), 1)} s`);
      view.showPlan(preview, end());
    }
  });
  return element;
}
