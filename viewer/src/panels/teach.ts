// Leading an arm by hand: begin, save poses, and hold it where it is. The words and conditions of `dimos arm teach`.
import type {Context} from '../context';
import {button, el, setClass} from '../dom';
import {pause} from '../flow';
import {RpcError} from '../protocol';
import {savePose} from './save';

/** Longest wait for a hand to hold the arm still, and time between two attempts to take it over [ms]. */
const STILL_LIMIT = 30_000;
const RETRY = 200;

export function teachPanel(context: Context): HTMLElement {
  const {run, flow} = context;
  const supported = el('input', {id: 'support', attributes: {type: 'checkbox'}});
  const support = el(
    'label',
    {class: 'check support'},
    supported,
    el('span', {text: 'I support the arm: its motors go off, and it falls otherwise'}),
  );
  const report = el('div', {class: 'report', id: 'teach-report', attributes: {role: 'status'}});
  let taking = '';
  const say = (level: string, text: string, hint?: string) =>
    report.replaceChildren(el('div', {class: level, text}), ...(hint ? [el('div', {class: 'hint', text: hint})] : []));
  const refused = (error: unknown) => {
    const known = error instanceof RpcError ? error : new RpcError('INTERNAL', String(error));
    say('bad', known.message, known.hint);
  };
  const lead = async () => {
    const arm = context.selected;
    try {
      const params = {arm, support_the_arm: supported.checked};
      const {note} = await run.work.request<{note?: string}>('arm_teach', params);
      say('good', `${arm}: ${note ?? 'led by hand'}`, 'hold it still before you end it');
    } catch (error) {
      refused(error);
    }
    // Each time is a deliberate one.
    supported.checked = false;
    show();
  };
  /** Takes the arm over as soon as it is held still. */
  const takeOver = async () => {
    const arm = context.selected;
    taking = arm;
    show();
    for (const began = performance.now(); ; ) {
      try {
        await run.work.request('arm_take_over', {arm});
        say('good', `${arm}: ready, held where it is`);
        break;
      } catch (error) {
        const moves = error instanceof RpcError && error.code === 'ARM_NOT_READY';
        if (!moves || performance.now() - began > STILL_LIMIT) {
          refused(error);
          break;
        }
        say('', `hold ${arm} still: it is taken over at rest`);
        await pause(RETRY);
      }
    }
    taking = '';
    show();
  };
  const begin = button('Lead by hand', () => void lead(), {
    id: 'teach',
    title: 'Lets a hand move the arm, until End',
  });
  const end = button('End: hold it here', () => void takeOver(), {
    id: 'teach-end',
    class: 'primary',
    title: 'Holds the arm where it is, once it is at rest',
  });
  const element = el(
    'fieldset',
    {class: 'acts teach'},
    el('h2', {text: 'Teach'}),
    support,
    el('div', {class: 'buttons two'}, begin, end),
    savePose(context),
    report,
  );
  const show = () => {
    const arm = run.arm(context.selected);
    const led = arm?.phase === 'led' && arm.led_by !== 'controller';
    setClass(support, 'hidden', arm?.teach !== 'motors_off' || led);
    begin.disabled = !arm || arm.phase === 'led' || flow.busy || (arm.teach === 'motors_off' && !supported.checked);
    end.disabled = !led || taking === context.selected;
    setClass(element, 'led', led);
  };
  supported.addEventListener('change', show);
  run.onStatus.on(show);
  flow.changed.on(show);
  context.onSelect.on(() => {
    supported.checked = false;
    report.replaceChildren();
    show();
  });
  show();
  return element;
}
