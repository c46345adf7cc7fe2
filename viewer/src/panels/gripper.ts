// The gripper of the selected arm: open, close, a position; and how the run judges the grip.
import type {Context} from '../context';
import {button, el, setClass, setText, setValueText} from '../dom';
import {pause} from '../flow';
import {figure} from '../units';

interface Grip {
  done: boolean;
  outcome?: string | null;
  error?: string | null;
  position: number;
  unit: string;
}

export function gripperPanel(context: Context): HTMLElement {
  const {run} = context;
  const range = el('input', {attributes: {type: 'range', min: '0', max: '1000', 'aria-label': 'gripper position'}});
  const value = el('output');
  const outcome = el('span', {class: 'minor', id: 'grip'});
  let busy = false;
  let touched = false;

  const onOff = () => run.arm(context.selected)?.gripper_unit === 'on_off';
  const limits = () => run.arm(context.selected)?.gripper_range ?? null;
  const text = (position: number) => {
    if (onOff()) return position ? 'open' : 'closed';
    const turns = run.arm(context.selected)?.gripper_unit === 'rad';
    return turns ? `${figure(position, 3)} rad` : `${figure(position * 1000, 1)} mm`;
  };
  const say = (position: number) => {
    setText(value, text(position));
    setValueText(range, value.textContent);
  };
  const target = () => {
    const [low, high] = limits() ?? [0, 0];
    return low + (Number(range.value) / 1000) * (high - low);
  };
  const command = async (position: number) => {
    const arm = context.selected;
    busy = true;
    show();
    try {
      const reply = await context.act<{order: number}>('gripper', {arm, position});
      for (let grip: Grip | null = null; reply && !grip?.done; ) {
        grip = await run.work.request<Grip>('grip', {arm, order: reply.order});
        setText(outcome, grip.error ?? (grip.done ? `${grip.outcome} at ${text(grip.position)}` : 'moving…'));
        await pause(100);
      }
    } catch (error) {
      context.report(error);
    }
    // The arm is free for other programs again.
    await run.work.request('release', {arm}).catch(() => {});
    busy = touched = false;
    show();
  };
  const open = button('Open', () => void command(limits()![1]), {id: 'grip-open'});
  const close = button('Close', () => void command(limits()![0]), {id: 'grip-close'});
  const go = button('Set', () => void command(target()), {
    id: 'grip-set',
    title: 'Moves the gripper to the position of the slider',
  });
  range.addEventListener('input', () => {
    touched = true;
    say(target());
    show();
  });
  const slider = el('label', {class: 'slider plain'}, el('span', {text: 'position'}), range, value);
  const element = el(
    'fieldset',
    {class: 'acts gripper'},
    el('h2', {text: 'Gripper'}),
    slider,
    el('div', {class: 'buttons'}, open, close, go),
    outcome,
  );
  const show = () => {
    const has = limits();
    setClass(element, 'hidden', !has);
    for (const each of [open, close]) each.disabled = busy;
    go.disabled = busy || !touched;
    // One that only opens and closes has no other position.
    for (const each of [go, slider]) setClass(each, 'hidden', onOff());
    const position = run.armState(context.selected)?.gripper;
    if (!has || touched || typeof position !== 'number') return;
    range.value = String(Math.round(((position - has[0]) / (has[1] - has[0] || 1)) * 1000));
    say(position);
  };
  run.onStatus.on(show);
  context.onSelect.on(() => {
    touched = false;
    setText(outcome, '');
    show();
  });
  show();
  return element;
}
