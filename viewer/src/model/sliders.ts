// One slider for each joint of a robot, within its limits, and its named poses.
import type {Context} from '../context';
import {button, choice, el, setText, setValueText} from '../dom';
import type {SceneRobot} from '../protocol';
import {angle, figure, shortJoint} from '../units';
import type {Posed} from './posed';

const STEPS = 2000;

export function sliders(context: Context, run: Posed, robot: SceneRobot): HTMLElement {
  const linear = (joint: string) => context.view.robots.get(robot.name)!.isLinear(joint);
  const rows = Object.keys(robot.joints).map((joint) => {
    const [lower, upper] = run.limits(robot, joint);
    const name = shortJoint(joint, robot.name);
    const input = el('input', {
      attributes: {type: 'range', min: '0', max: String(STEPS), 'aria-label': name, 'data-joint': joint},
    });
    const output = el('input', {
      class: 'value',
      attributes: {type: 'number', step: 'any', 'aria-label': `${name} position`},
    });
    const factor = () => (linear(joint) ? 1 : angle.factor);
    const text = (value: number) => {
      const digits = linear(joint) ? 4 : angle.unit === 'deg' ? 1 : 3;
      return figure(value * factor(), digits).replace('−', '-');
    };
    input.addEventListener('input', () => run.move(joint, lower + (Number(input.value) / STEPS) * (upper - lower)));
    output.addEventListener('change', () => {
      const value = output.valueAsNumber / factor();
      if (!Number.isFinite(value)) return;
      const within = Math.min(upper, Math.max(lower, value));
      run.move(joint, within);
      // The field shows what counts, also while it has the focus.
      if (within !== value) output.value = text(within);
    });
    const show = () => {
      const value = run.position(joint);
      const step = String(Math.round(((value - lower) / (upper - lower || 1)) * STEPS));
      if (input.value !== step && document.activeElement !== input) input.value = step;
      const written = text(value);
      setValueText(input, `${written} ${linear(joint) ? 'm' : angle.label}`);
      if (document.activeElement !== output && output.value !== written) output.value = written;
    };
    return {show, element: el('label', {class: 'slider'}, el('span', {text: name, title: joint}), input, output)};
  });
  const note = el('p', {class: 'minor'});
  const show = () => {
    for (const row of rows) row.show();
    const lengths = Object.keys(robot.joints).some(linear) ? ', or m' : '';
    setText(note, `in ${angle.unit === 'deg' ? 'degrees' : 'rad'}${lengths}`);
  };
  const unit = choice(
    [
      ['rad', 'rad'],
      ['deg', 'deg'],
    ] as const,
    angle.unit,
    (value) => angle.set(value),
  );
  angle.changed.on(() => unit.choose(angle.unit));
  run.onMove.on(show);
  angle.changed.on(show);
  const poses = Object.entries(robot.groups ?? {}).map(([name, positions]) =>
    button(name, () => run.pose(robot, positions), {attributes: {'data-pose': name}}),
  );
  const zero = button('all 0', () => run.zero(robot), {title: 'As close to zero as the limits allow'});
  const several = run.scene.robots.length > 1;
  return el(
    'section',
    {class: 'posed'},
    el('div', {class: 'section-head'}, el('h2', {text: several ? `Joints of ${robot.name}` : 'Joints'}), unit.element),
    el('div', {class: 'chips'}, ...poses, zero),
    el('div', {class: 'sliders'}, ...rows.map((row) => row.element)),
    note,
  );
}
