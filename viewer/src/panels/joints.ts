// Joints of the selected arm: where each is between its limits, velocity, effort; pose of the tool, gripper.
import type {Context} from '../context';
import {choice, el, jointColor, setClass, setText} from '../dom';
import {angle, angleText, figure, shortJoint} from '../units';

const NEAR = 0.05; // of the range: a joint so close to a limit is marked
const PERIOD = 100; // ms between two updates of the table

export function jointsPanel(context: Context): HTMLElement {
  const {run} = context;
  const title = el('h2');
  const unit = choice(
    [
      ['rad', 'rad'],
      ['deg', 'deg'],
    ] as const,
    angle.unit,
    (value) => angle.set(value),
  );
  const body = el('tbody');
  const units = [el('th'), el('th'), el('th')] as const;
  const pose = el('dl', {class: 'pose', id: 'pose'});
  const table = el(
    'table',
    {class: 'joints'},
    el('thead', {}, el('tr', {}, el('th', {text: 'joint'}), el('th', {class: 'wide'}), ...units)),
    body,
  );
  let rows: {bar: HTMLElement; row: HTMLElement; cells: HTMLElement[]; joint: string}[] = [];
  let limits: (readonly [number, number] | null)[] = [];

  const build = () => {
    const arm = context.arm;
    setText(title, arm && run.scene.arms.length > 1 ? `Joints of ${arm.name}` : 'Joints');
    rows = (arm?.joints ?? []).map((joint, i) => {
      const name = el('td', {class: 'swatch', text: shortJoint(joint, arm!.name), title: joint});
      name.style.setProperty('--color', jointColor(i));
      const bar = el('i');
      const cells = [el('td', {class: 'number'}), el('td', {class: 'number'}), el('td', {class: 'number'})];
      const row = el('tr', {}, name, el('td', {class: 'wide'}, el('div', {class: 'bar'}, bar)), ...cells);
      return {bar, row, cells, joint};
    });
    body.replaceChildren(...rows.map(({row}) => row));
    head();
    readLimits();
    show();
  };
  const head = () => {
    const texts = [angle.label, angle.unit === 'deg' ? '°/s' : 'rad/s', 'Nm'];
    for (const [i, cell] of units.entries()) setText(cell, texts[i]!);
  };
  const readLimits = () => {
    const known = run.arm(context.selected)?.position_limits;
    const model = context.robotOf(context.selected)?.limits;
    limits = rows.map(({joint, bar}, i) => {
      const [lower, upper] = known?.[i] ?? [model?.[joint]?.lower, model?.[joint]?.upper];
      if (typeof lower !== 'number' || typeof upper !== 'number') return null;
      const text = `${angleText(lower)} … ${angleText(upper)} ${angle.label}`;
      if (bar.parentElement!.title !== text) bar.parentElement!.title = text;
      return [lower, upper] as const;
    });
  };
  const show = () => {
    const joints = run.joints;
    rows.forEach(({bar, row, cells, joint}, i) => {
      const index = joints ? joints.name.indexOf(joint) : -1;
      const value = joints?.position[index] ?? null;
      setText(cells[0]!, angleText(value));
      setText(cells[1]!, scaled(joints?.velocity[index]));
      setText(cells[2]!, figure(joints?.effort[index], 1));
      const limit = limits[i];
      bar.hidden = !limit || value === null;
      if (!limit || value === null) return;
      const fraction = (value - limit[0]) / (limit[1] - limit[0] || 1);
      const left = `${(Math.min(1, Math.max(0, fraction)) * 100).toFixed(1)}%`;
      if (bar.style.left !== left) bar.style.left = left;
      setClass(row, 'near', fraction < NEAR || fraction > 1 - NEAR);
    });
  };
  const showPose = () => {
    const state = run.armState(context.selected);
    const lines: [string, string][] = [];
    if (state?.pose) {
      lines.push(['xyz', `${state.pose.xyz.map((v) => figure(v, 4)).join('  ')} m`]);
      lines.push(['rpy', `${state.pose.rpy.map(angleText).join('  ')} ${angle.label}`]);
    }
    if (typeof state?.gripper === 'number') {
      const mm = state.gripper_unit === 'm';
      const ordered = state.gripper ? 'open (as ordered)' : 'closed (as ordered)';
      const position = mm ? `${figure(state.gripper * 1000, 1)} mm` : `${angleText(state.gripper)} ${angle.label}`;
      const force =
        typeof state.gripper_force === 'number'
          ? `  ${figure(state.gripper_force, 1)} ${state.gripper_force_unit}`
          : '';
      lines.push(['gripper', state.gripper_unit === 'on_off' ? ordered : `${position}${force}`]);
    }
    if (state?.wrench) {
      lines.push([
        'force',
        `${state.wrench
          .slice(0, 3)
          .map((v) => figure(v, 1))
          .join('  ')} N`,
      ]);
      lines.push([
        'torque',
        `${state.wrench
          .slice(3)
          .map((v) => figure(v, 2))
          .join('  ')} Nm`,
      ]);
    }
    if (pose.children.length !== lines.length * 2) {
      pose.replaceChildren(...lines.flatMap(() => [el('dt'), el('dd')]));
    }
    lines.forEach(([name, text], i) => {
      setText(pose.children[2 * i]!, name);
      setText(pose.children[2 * i + 1]!, text);
    });
  };

  let last = 0;
  run.onJoints.on(() => {
    if (performance.now() - last < PERIOD) return;
    last = performance.now();
    show();
  });
  run.onState.on(showPose);
  run.onStatus.on(readLimits);
  context.onSelect.on(build);
  angle.changed.on(() => {
    head();
    readLimits();
    show();
    showPose();
  });
  build();
  const element = el(
    'section',
    {class: 'joints live'},
    el('div', {class: 'section-head'}, title, unit.element),
    table,
    el('h3', {text: 'Tool centre point', class: 'minor'}),
    pose,
  );
  run.onState.on(() => setClass(element, 'old', run.armStale(context.selected)));
  return element;
}

function scaled(velocity: number | null | undefined): string {
  return figure(typeof velocity === 'number' ? velocity * angle.factor : null, angle.unit === 'deg' ? 1 : 3);
}
