// The jog panel: buttons and keys that move single joints or the end effector while they are held.
import type {Context} from '../context';
import {button, choice, el, setClass, setText, setValueText} from '../dom';
import {Jog, type JogMode, type Motion, SPEEDS, TOP} from '../jog';
import {angle, angleText, figure, shortJoint} from '../units';
import {teachPanel} from './teach';

/** Keys of the end effector: those of `dimos jog`. */
const AXES = [
  ['x', 'w', 's'],
  ['y', 'a', 'd'],
  ['z', 'q', 'e'],
  ['roll', 'r', 'f'],
  ['pitch', 't', 'g'],
  ['yaw', 'y', 'h'],
] as const;
const NEAR = 0.05; // of the range: a joint so close to a limit is marked

interface Row {
  motion: {kind: Motion['kind']; index: number};
  element: HTMLElement;
  buttons: HTMLButtonElement[];
  bar: HTMLElement;
  value: HTMLElement;
  joint: string;
}

export function jogPanel(context: Context): HTMLElement {
  const {run, flow} = context;
  const jog = new Jog(context);
  let wanted = jog.mode;
  const title = el('h2');
  const modes = choice<JogMode>(
    [
      ['tool', 'Tool'],
      ['joints', 'Joints'],
    ],
    jog.mode,
    (mode) => {
      wanted = mode;
      jog.set({mode});
    },
  );
  const frames = choice(
    [
      ['base', 'Base axes'],
      ['tool', 'Tool axes'],
    ] as const,
    jog.frame,
    (frame) => jog.set({frame}),
  );
  const speed = el('input', {
    id: 'jog-speed',
    attributes: {type: 'range', min: '0', max: String(SPEEDS.length - 1), 'aria-label': 'speed of jogging'},
  });
  speed.addEventListener('input', () => jog.set({speed: Number(speed.value)}));
  const speedText = el('output', {class: 'jog-speed'});
  const checked = el('p', {id: 'jog-checked'});
  const missing = el('div', {class: 'note warn', id: 'jog-missing'});
  const rows = el('div', {class: 'jog-rows', id: 'jog-rows'});
  const report = el('div', {class: 'report', id: 'jog-report', attributes: {role: 'status'}});
  const keys = button('Keys', () => setKeys(keys.getAttribute('aria-pressed') !== 'true'), {
    id: 'jog-keys',
    title: 'Jog by the keys shown on the buttons, while this tab is open and nothing is typed',
    attributes: {'aria-pressed': 'false'},
  });
  const keysText = el('span', {class: 'minor'});
  let list: Row[] = [];
  let chosen = 0;
  let built = '';

  const keysOn = () => keys.getAttribute('aria-pressed') === 'true' && document.body.dataset.tab === 'jog';
  const setKeys = (on: boolean) => {
    keys.setAttribute('aria-pressed', String(on));
    jog.releaseAll();
    show();
  };
  const build = () => {
    const drive = jog.drive(jog.mode);
    const names = jog.mode === 'tool' ? AXES.map(([name]) => name) : (drive?.joints ?? context.arm?.joints ?? []);
    list = names.map((name, index) => {
      const motion = {kind: jog.mode === 'tool' ? 'axis' : 'joint', index} as const;
      const text = jog.mode === 'tool' ? name : shortJoint(name, context.selected);
      const buttons = ([-1, 1] as const).map((sign) => holdButton(jog, {...motion, sign}, text));
      const [value, bar] = [el('span', {class: 'number'}), el('i')];
      const label = el('div', {class: 'jog-label', title: name}, el('span', {text}), value);
      if (jog.mode === 'joints') label.append(el('div', {class: 'bar'}, bar));
      const element = el('div', {class: 'jog-row'}, buttons[0]!, label, buttons[1]!);
      label.addEventListener('click', () => choose(index));
      return {motion, element, buttons, bar, value, joint: jog.mode === 'joints' ? name : ''};
    });
    rows.replaceChildren(...list.map(({element}) => element));
  };
  const choose = (index: number) => {
    if (jog.mode !== 'joints' || index < 0 || index >= list.length) return;
    jog.releaseAll();
    chosen = index;
    show();
  };
  const show = () => {
    // A run may have tasks for one of the two only.
    const has = {tool: jog.drive('tool'), joints: jog.drive('joints')};
    const key = `${context.selected} ${jog.mode} ${has.joints?.joints}`;
    if (key !== built) {
      built = key;
      chosen = 0;
      build();
    }
    modes.choose(jog.mode);
    const [drive, arm] = [has[jog.mode], run.arm(context.selected)];
    setText(title, run.scene.arms.length > 1 ? `Jog ${context.selected}` : 'Jog');
    setClass(frames.element, 'hidden', jog.mode !== 'tool');
    setClass(missing, 'hidden', !!drive || !run.status);
    // The collision guard of the run knows the robots of its own planner.
    const guarded = run.status?.planner?.robots.includes(context.selected) && !run.status.planner.attached;
    const stops = 'The arm moves while a button is held; released, it decelerates to rest.';
    checked.className = guarded ? 'note' : 'note warn';
    setText(checked, guarded ? `Stops before what the planner knows. ${stops}` : `Not collision-checked. ${stops}`);
    if (!drive) missing.replaceChildren(el('span', {text: missingTask(context, jog.mode)}));
    speed.value = String(jog.speed);
    setText(speedText, speedOf(jog));
    setValueText(speed, speedText.textContent);
    const ready = !!drive && !flow.busy;
    for (const {buttons, motion} of list) {
      buttons.forEach((each, i) => {
        each.disabled = !ready;
        const held = jog.isHeld({...motion, sign: i ? 1 : -1});
        setClass(each, 'held', held);
        each.setAttribute('aria-pressed', String(held));
        setText(each.querySelector('kbd')!, keysOn() ? keyOf(jog.mode, motion.index, i, chosen) : '');
      });
    }
    for (const [i, {element}] of list.entries())
      setClass(element, 'chosen', jog.mode === 'joints' && keysOn() && i === chosen);
    const on = keys.getAttribute('aria-pressed') === 'true';
    const meaning = jog.mode === 'tool' ? 'hold a key; [ ] speed, B axes' : '1–9 joint, hold + or −; [ ] speed';
    setText(keysText, on ? meaning : '');
    const lines: HTMLElement[] = [];
    const {problem, task} = jog;
    if (problem) lines.push(el('div', {class: 'bad', text: problem.text}));
    if (problem?.hint) lines.push(el('div', {class: 'hint', text: problem.hint}));
    if (!problem && jog.active) lines.push(el('div', {class: 'good', text: `${context.selected} is jogged`}));
    if (!problem && jog.active && task?.bound) lines.push(el('div', {class: 'warn', text: `limited by ${task.bound}`}));
    if (!problem && !jog.active && arm && arm.phase !== 'ready')
      lines.push(el('div', {class: 'minor', text: `${context.selected} is ${arm.phase}, not ready to be jogged`}));
    report.replaceChildren(...lines);
    showValues();
  };
  const showValues = () => {
    const arm = run.arm(context.selected);
    const pose = run.armState(context.selected)?.pose;
    list.forEach(({element, value, bar, joint, motion}) => {
      if (!joint) {
        const at = motion.index < 3 ? pose?.xyz[motion.index] : pose?.rpy[motion.index - 3];
        setText(value, motion.index < 3 ? `${figure(at, 3)} m` : `${angleText(at)} ${angle.label}`);
        return;
      }
      const position = context.position(joint);
      const place = context.arm?.joints.indexOf(joint) ?? -1;
      const [lower, upper] = arm?.position_limits[place] ?? [-Math.PI, Math.PI];
      setText(value, `${angleText(position)} ${angle.label}`);
      const part = position === null ? 0.5 : Math.min(1, Math.max(0, (position - lower) / (upper - lower || 1)));
      const left = `${(part * 100).toFixed(1)}%`;
      if (bar.style.left !== left) bar.style.left = left;
      bar.parentElement!.title = `${angleText(lower)} … ${angleText(upper)} ${angle.label}`;
      setClass(element, 'near', part < NEAR || part > 1 - NEAR);
    });
  };

  const keyDown = (event: KeyboardEvent) => {
    const typed = event.target instanceof Element && event.target.closest('input:not([type=range]), select, textarea');
    // While one of these is down, browsers may not report that another key is released.
    if (event.ctrlKey || event.altKey || event.metaKey) return jog.releaseAll();
    if (!keysOn() || typed) return;
    const pressed = event.key.toLowerCase();
    const motion = motionOf(pressed, jog.mode, chosen);
    if (motion) {
      event.preventDefault();
      if (!event.repeat && !list[motion.index]?.buttons[0]?.matches(':disabled')) jog.hold(`key ${event.code}`, motion);
    } else if (pressed === '[' || pressed === ']') jog.set({speed: jog.speed + (pressed === ']' ? 1 : -1)});
    else if (pressed === 'b' && jog.mode === 'tool') {
      jog.set({frame: jog.frame === 'base' ? 'tool' : 'base'});
      frames.choose(jog.frame);
    } else if (/^[1-9]$/.test(pressed)) choose(Number(pressed) - 1);
  };
  window.addEventListener('keydown', keyDown);
  window.addEventListener('keyup', (event) => jog.release(`key ${event.code}`));
  // Also where the pointer left its button, or the button was disabled meanwhile.
  for (const name of ['pointerup', 'pointercancel', 'lostpointercapture'] as const)
    window.addEventListener(name, (event) => jog.release(`pointer ${event.pointerId}`), {capture: true});
  // The selected mode if the arm has a task for it, else the other. At once with the selection: a change of mode
  // releases what is held, which may be pressed before the next status comes.
  let chosenFor = '';
  const follow = () => {
    if (chosenFor === context.selected || !run.status) return;
    chosenFor = context.selected;
    const other = wanted === 'tool' ? 'joints' : 'tool';
    jog.set({mode: jog.drive(wanted) || !jog.drive(other) ? wanted : other});
  };
  context.onSelect.on(follow);
  run.onStatus.on(follow);
  jog.changed.on(show);
  flow.changed.on(show);
  context.onSelect.on(show);
  context.onTab.on(() => {
    jog.releaseAll();
    show();
  });
  angle.changed.on(show);
  run.onState.on(showValues);
  show();

  return el(
    'section',
    {class: 'jog', attributes: {'data-panel': 'jog'}},
    el(
      'fieldset',
      {class: 'acts'},
      el('div', {class: 'section-head'}, title, modes.element),
      checked,
      missing,
      el('label', {class: 'slider plain'}, el('span', {text: 'speed'}), speed, speedText),
      frames.element,
      rows,
      el('div', {class: 'row'}, keys, keysText),
      report,
    ),
    teachPanel(context),
  );
}

/** A button that moves while it is held. */
function holdButton(jog: Jog, motion: Motion, name: string): HTMLButtonElement {
  const sign = motion.sign > 0 ? '+' : '−';
  const element = button(sign, () => {}, {
    class: 'hold',
    attributes: {'aria-label': `${name} ${sign}`, 'data-jog': `${name}${motion.sign > 0 ? '+' : '-'}`},
  });
  element.append(el('kbd'));
  element.addEventListener('pointerdown', (event) => {
    if (event.button !== 0) return;
    event.preventDefault();
    // Its end comes here also if the pointer leaves the window.
    element.setPointerCapture(event.pointerId);
    jog.hold(`pointer ${event.pointerId}`, motion);
  });
  // A long touch would open a menu.
  element.addEventListener('contextmenu', (event) => event.preventDefault());
  return element;
}

function motionOf(key: string, mode: JogMode, joint: number): Motion | null {
  if (mode === 'joints') {
    const sign = ['+', '=', 'arrowup', 'arrowright'].includes(key) ? 1 : -1;
    const meant = sign > 0 || ['-', '_', 'arrowdown', 'arrowleft'].includes(key);
    return meant ? {kind: 'joint', index: joint, sign} : null;
  }
  const index = AXES.findIndex(([, up, down]) => key === up || key === down);
  return index < 0 ? null : {kind: 'axis', index, sign: key === AXES[index]![1] ? 1 : -1};
}

function keyOf(mode: JogMode, index: number, side: number, chosen: number): string {
  if (mode === 'tool') return AXES[index]![side ? 1 : 2].toUpperCase();
  return index === chosen ? (side ? '+' : '−') : side ? '' : String(index + 1);
}

function speedOf(jog: Jog): string {
  const share = jog.fraction;
  const percent = `${Math.round(share * 100)} %`;
  const turn = (value: number) => `${figure(value * angle.factor, angle.unit === 'deg' ? 1 : 3)} ${angle.label}/s`;
  if (jog.mode === 'joints') return `${percent} · ${turn(share * TOP.joint)}`;
  return `${percent} · ${figure(share * TOP.linear * 1000, 0)} mm/s · ${turn(share * TOP.angular)}`;
}

/** Why a mode is not there, with the line to add: that of `dimos jog`. */
function missingTask({selected: arm, run}: Context, mode: JogMode): string {
  // A planner knows the arm's model.
  const params = run.scene.planner
    ? '}'
    : `, params: {model_path: MODEL, end_effector_link: LINK, joint_prefix: ${arm}_}} ` +
      '(MODEL: the description of the arm, a file or builtin:NAME; LINK: its flange in it)';
  return mode === 'joints'
    ? `no task of the run moves single joints of ${arm}; add to tasks of the blueprint: ` +
        `- {name: servo_${arm}, type: servo, joint_names: {hardware: ${arm}}, priority: 20}`
    : `no task of the run moves the end effector of ${arm}; add to tasks of the blueprint: ` +
        `- {name: twist_${arm}, type: eef_twist, joint_names: {hardware: ${arm}}, priority: 21${params}`;
}
