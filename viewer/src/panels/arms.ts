// Arms of the run: state, cause of a hold, faults with what to do, and the acts that make an arm ready again.
import type {Context} from '../context';
import {button, el, setClass, setText} from '../dom';
import type {ArmStatus, Status, Task, Who} from '../protocol';
import {duration, figure} from '../units';

/** How an arm's phase is coloured. */
const LEVELS: Record<string, string> = {
  ready: 'good',
  activating: 'warn',
  standby: 'warn',
  led: 'info',
  held: 'bad',
  disabled: 'muted',
  unknown: 'muted',
};

export function armsPanel(context: Context): HTMLElement {
  const cards = context.run.scene.arms.map(({name}) => card(context, name));
  const element = el('section', {class: 'arms'}, ...cards.map((each) => each.element));
  const show = () => {
    for (const each of cards) each.show(context.run.status);
  };
  context.run.onStatus.on(show);
  context.onSelect.on(show);
  show();
  return element;
}

function card(context: Context, name: string) {
  const phase = el('span', {class: 'phase'});
  const figures = el('div', {
    class: 'figures',
    title: 'adapter and address, rate of new states, age of the newest one',
  });
  const notes = el('div', {class: 'notes'});
  const reset = button('Reset', () => void context.act('arm_reset', {arm: name}), {
    class: 'reset',
    title: 'Clears a hold or a fault. Moves nothing, enables nothing',
  });
  const enable = button('Enable', () => void context.act('arm_enable', {arm: name}), {
    class: 'enable',
    title: 'Enables the motors where the arm is',
  });
  const head = button('', () => context.select(name), {class: 'card-head'});
  head.append(el('strong', {text: name}), phase);
  const element = el(
    'article',
    {class: 'card', attributes: {'data-arm': name}},
    head,
    figures,
    notes,
    el('fieldset', {class: 'acts row'}, reset, enable),
  );
  const show = (status: Status | null) => {
    setClass(element, 'selected', context.selected === name && context.run.scene.arms.length > 1);
    const arm = status?.arms.find((each) => each.hardware_id === name);
    if (!arm || !status) return;
    setText(phase, arm.link === 'up' ? arm.phase : `${arm.link} · ${arm.phase}`);
    phase.dataset.level = arm.link === 'up' ? (LEVELS[arm.phase] ?? 'muted') : 'bad';
    const rate = figure(arm.measured_rate_hz, 0);
    const old = arm.state_age_ms === null ? 'no state yet' : `age ${duration(arm.state_age_ms)}`;
    setText(
      figures,
      `${arm.adapter} at ${arm.address} · ${rate} Hz · ${old} · ${arm.enabled ? 'motors on' : 'motors off'}`,
    );
    notes.replaceChildren(
      ...notesOf(arm, tasksOf(status, context.run.scene.arms.find((a) => a.name === name)!.joints)),
    );
    const latched = arm.phase === 'held' || arm.error !== null || arm.link === 'faulted';
    reset.disabled = !latched;
    enable.disabled = latched || arm.phase === 'ready' || arm.phase === 'activating';
    setClass(reset, 'attention', latched);
    setClass(enable, 'attention', !enable.disabled);
  };
  return {element, show};
}

function tasksOf(status: Status, joints: string[]): Task[] {
  return status.tasks.filter((task) => task.joints.some((joint) => joints.includes(joint)));
}

/** Whether why a motion ended is over: somebody wanted that, or the arm was held and is ready again. */
function isOver(reason: string | null, arm: ArmStatus): boolean {
  const held = reason?.startsWith(`${arm.hardware_id} is held`);
  return reason === 'cancelled' || (!!held && arm.phase === 'ready');
}

/** Who made a request, as the terminal writes it. */
function shown(who: Who): string {
  const process = who.pid ? `pid ${who.pid}` : '';
  const more = [process, who.user ? `user ${who.user}` : ''].filter((part) => part !== '');
  return more.length > 0 ? `${who.program} (${more.join(', ')})` : who.program;
}

/** What a person must know about an arm: the cause of a hold, errors, faults that last, who commands it. */
function notesOf(arm: ArmStatus, tasks: Task[]): HTMLElement[] {
  const notes: HTMLElement[] = [];
  const note = (level: string, text: string, hint?: string) =>
    notes.push(
      el('div', {class: `note ${level}`}, el('span', {text}), hint ? el('span', {class: 'hint', text: hint}) : null),
    );
  if (arm.stop_pending) note('bad', 'a stop could not be sent', 'it is delivered when the arm is reachable again');
  if (arm.cause) {
    const by = arm.cause.by ? `: ${shown(arm.cause.by)}` : '';
    note('bad', `held: ${arm.cause.text}${by}`, 'when it may move again: Reset, then Enable');
  }
  if (arm.error) note('bad', `error ${arm.error.code}: ${arm.error.text}`, 'remove the cause, then Reset');
  const speed = arm.speed_fraction ?? 1;
  if (speed < 1e-4) note('warn', 'stopped by its controller at 0 % of the speed', 'motions wait on their paths');
  else if (speed < 0.9995) note('warn', `slowed by its controller to ${(100 * speed).toFixed(1)} % of the speed`);
  if (!arm.cause && arm.phase === 'standby') note('warn', 'not ready', 'Enable makes it ready where it is');
  for (const text of arm.model_notes ?? []) {
    note(text.includes('refused') ? 'bad' : text.includes('padding') ? 'warn' : 'muted', `model: ${text}`);
  }
  for (const fault of arm.faults.slice(-3).reverse()) {
    const times = fault.count > 1 ? `, ${fault.count} times` : '';
    note(
      fault.over ? 'muted' : 'bad',
      `${fault.text} (${duration(fault.since * 1000)} ago${fault.over ? ', over' : ''}${times})`,
    );
  }
  for (const task of tasks) {
    if (task.state === 'EXECUTING' || task.state === 'CANCELLING') {
      const progress = task.progress === null ? '' : ` ${Math.round(task.progress * 100)} %`;
      note('info', `${task.name}: ${task.state.toLowerCase()}${progress}`);
    } else if ((task.state === 'ABORTED' && !isOver(task.reason, arm)) || task.state === 'FAULT') {
      note('warn', `${task.name}: ${task.state.toLowerCase()}${task.reason ? ` (${task.reason})` : ''}`);
    }
  }
  if (arm.commander) note('info', `commanded by ${arm.commander.program}`);
  return notes;
}
