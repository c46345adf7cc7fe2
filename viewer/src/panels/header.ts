// The bar at the top: which run, simulated or real, age of the data, speed override, pause, and Stop.
import type {Context} from '../context';
import {button, el, setClass, setText, setValueText} from '../dom';
import {duration} from '../units';

export function header(context: Context): {element: HTMLElement; stop: HTMLElement} {
  const {run} = context;
  const real = !run.scene.simulated;
  const age = el('span', {class: 'age', id: 'age', attributes: {role: 'status'}});
  const badge = el('span', {
    class: real ? 'badge real' : 'badge simulated',
    id: 'banner',
    text: real ? 'REAL ARM' : 'SIMULATED',
    title: real ? 'Acts move real hardware' : 'No hardware moves: emulators or ideal arms',
  });
  const element = el(
    'header',
    {},
    el('div', {class: 'title'}, el('strong', {text: run.scene.name}), badge, age),
    override(context),
  );

  const show = () => {
    const {text, level} = dataAge(context);
    setText(age, text);
    age.dataset.level = level;
    document.body.classList.toggle('stale', level === 'warn' || level === 'bad');
    document.body.classList.toggle('offline', !run.connected);
  };
  run.onLink.on(show);
  run.onJoints.on(() => {
    if (age.dataset.level !== 'good') show();
  });
  window.setInterval(show, 100);
  run.onStatus.on(({arms}) => {
    // An arm may be real where the scene's file said otherwise: the run knows best.
    const some = arms.some((arm) => !arm.simulated);
    setText(badge, some ? 'REAL ARM' : 'SIMULATED');
    setClass(badge, 'real', some);
    setClass(badge, 'simulated', !some);
  });
  return {element, stop: stopButton(context)};
}

function dataAge({run}: Context): {text: string; level: string} {
  const broken = [run.work, run.watch].find((each) => each.state !== 'open');
  // The token was right before.
  if (broken?.state === 'refused') {
    return {text: 'another run has taken this address: open the one that `dimos view` prints', level: 'bad'};
  }
  if (broken?.state === 'lost') {
    const wait = broken.retryAt - performance.now();
    const next = broken.retryAt && wait > 0 ? `next attempt in ${(wait / 1000).toFixed(1)} s` : 'reconnecting…';
    return {text: `${broken.full ? 'too many pages are open' : 'connection lost'} · ${next}`, level: 'bad'};
  }
  if (broken) return {text: 'connecting…', level: 'warn'};
  if (run.age === Infinity) return {text: 'waiting for data…', level: 'warn'};
  if (run.stale) return {text: `no data for ${duration(run.age)}`, level: 'bad'};
  for (const {name} of run.scene.arms) {
    const old = run.armAge(name);
    if (run.state && run.armStale(name)) {
      return {
        text: Number.isFinite(old) ? `${name}: no state for ${duration(old)}` : `${name}: no state yet`,
        level: 'old',
      };
    }
  }
  return {text: 'live', level: 'good'};
}

/** Speed of all motions of the run, and pause. */
function override(context: Context): HTMLElement {
  const {run} = context;
  const value = el('output', {text: '100 %'});
  const range = el('input', {
    id: 'speed',
    attributes: {
      type: 'range',
      min: '1',
      max: '100',
      value: '100',
      'aria-label': 'speed override',
    },
  });
  const show = () => {
    setText(value, `${range.value} %`);
    setValueText(range, value.textContent);
  };
  let held = 0; // the slider is the person's until shortly after the last touch
  range.addEventListener('input', () => {
    held = performance.now();
    show();
  });
  range.addEventListener('change', () => {
    held = performance.now();
    void context.act('speed', {fraction: Number(range.value) / 100});
  });
  const pause = button('Pause', () => void context.act('speed', {paused: !run.status?.speed.paused}), {
    id: 'pause',
    title: 'Pauses all motions on their paths',
  });
  run.onStatus.on(({speed}) => {
    setText(pause, speed.paused ? 'Resume' : 'Pause');
    setClass(pause, 'attention', speed.paused);
    if (performance.now() - held < 1500) return;
    range.value = String(Math.round(speed.fraction * 100));
    show();
  });
  return el(
    'fieldset',
    {class: 'override acts', title: 'Speed of all motions of the run'},
    el('span', {class: 'label', text: 'Speed'}),
    range,
    value,
    pause,
  );
}

/** Whether Space has a meaning of its own where the focus is: text, a button (not of jog), a check box, a list. */
function takesSpace(target: EventTarget | null): boolean {
  const takers = 'input:not([type=range]), button:not(.hold), select, textarea';
  return target instanceof Element && target.closest(takers) !== null;
}

/** Closes what is open over the page, or leaves the field that has the focus. Whether there was either. */
function leave(target: EventTarget | null): boolean {
  const dialog = document.querySelector<HTMLDialogElement>('dialog[open]');
  const field =
    target instanceof HTMLElement && target.closest<HTMLElement>('input:not([type=range]), select, textarea');
  dialog?.close();
  if (field) field.blur();
  return !!dialog || !!field;
}

function stopButton(context: Context): HTMLElement {
  const {run, stop} = context;
  const press = () => void stop.press();
  const lines = el('div', {class: 'stop-lines', id: 'stop-report', attributes: {role: 'alert'}});
  const control = button('STOP', press, {
    id: 'stop',
    title:
      'Holds all arms at once, until they are reset (Escape, or Space where nothing is typed; at rest, Escape leaves a field first). An operational stop, ' +
      'not a safety function',
  });
  control.append(el('kbd', {text: 'Esc'}));
  window.addEventListener(
    'keydown',
    (event) => {
      const meant = event.key === 'Escape' || (event.key === ' ' && !takesSpace(event.target));
      if (!meant) return;
      event.preventDefault();
      event.stopPropagation();
      // At rest, Escape first leaves a dialog or a field, as everywhere. In motion it is Stop.
      const left = event.key === 'Escape' && leave(event.target);
      if (!event.repeat && !(left && run.atRest)) press();
    },
    {capture: true},
  );
  // A button that was clicked gives the focus back, so that Space is Stop and does not click it again.
  document.addEventListener('click', ({target, detail}) => {
    const control = target instanceof Element && target.closest('button');
    if (control && detail > 0) control.blur();
  });
  stop.changed.on(() => {
    lines.replaceChildren(...stop.lines.map(({text, good}) => el('div', {class: good ? 'good' : 'bad', text})));
    setClass(control, 'active', stop.active);
  });
  return el('div', {class: 'stop'}, lines, control);
}
