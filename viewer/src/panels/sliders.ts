// One slider per joint of a joint goal, between its limits.
import type {Context} from '../context';
import {el, setClass, setText, setValueText} from '../dom';
import type {GoalEditor} from '../goal';
import {angle, angleText, shortJoint} from '../units';

const STEPS = 2000;

interface Slider {
  joint: string;
  input: HTMLInputElement;
  output: HTMLInputElement;
  lower: number;
  upper: number;
}

export function jointSliders(context: Context, editor: GoalEditor): HTMLElement {
  const element = el('div', {class: 'sliders', id: 'sliders'});
  let sliders: Slider[] = [];
  // The joint for which a position beyond its limits was entered, and the limit that is its goal in place of it.
  let beyond: {index: number; goal: number; text: string} | null = null;

  const limitsOf = (joint: string, index: number): [number, number] => {
    const planned = context.run.planner?.robots.find((robot) => robot.name === editor.robot?.name)?.limits[index];
    const model = editor.robot?.limits[joint];
    const reported = context.run.arm(context.selected)?.position_limits[index];
    const lower = planned?.[0] ?? reported?.[0] ?? model?.lower ?? -Math.PI;
    const upper = planned?.[1] ?? reported?.[1] ?? model?.upper ?? Math.PI;
    return [lower, upper];
  };
  const build = () => {
    beyond = null;
    sliders = editor.names.map((joint, index) => {
      const [lower, upper] = limitsOf(joint, index);
      const name = shortJoint(joint, context.selected);
      const input = el('input', {
        attributes: {type: 'range', min: '0', max: String(STEPS), 'aria-label': name, 'data-joint': joint},
      });
      const output = el('input', {
        class: 'value',
        attributes: {type: 'number', step: 'any', 'aria-label': `${name} position`},
      });
      const slider = {joint, input, output, lower, upper};
      input.addEventListener('input', () => {
        editor.setJoint(index, lower + (Number(input.value) / STEPS) * (upper - lower));
      });
      output.addEventListener('change', () => {
        const value = output.valueAsNumber / angle.factor;
        if (!Number.isFinite(value)) return;
        const within = Math.min(upper, Math.max(lower, value));
        // The field shows what counts, also while it has the focus.
        if (within !== value) output.value = angleText(within).replace('−', '-');
        const text = `${name} reaches ${angleText(lower)} to ${angleText(upper)} only`;
        beyond = within === value ? null : {index, goal: within, text};
        editor.setJoint(index, within);
        show();
      });
      element.append(el('label', {class: 'slider'}, el('span', {text: name, title: joint}), input, output));
      return slider;
    });
    const labels = sliders.map(({input}) => input.parentElement!);
    element.replaceChildren(...labels, el('p', {class: 'minor unit-note'}));
    show();
  };
  const show = () => {
    const values = editor.joints ?? editor.present();
    sliders.forEach(({input, output, lower, upper}, i) => {
      const step = String(Math.round(((values[i]! - lower) / (upper - lower)) * STEPS));
      if (input.value !== step && document.activeElement !== input) input.value = step;
      const text = angleText(values[i]).replace('−', '-');
      setValueText(input, `${text} ${angle.label}`);
      if (document.activeElement !== output && output.value !== text) output.value = text;
    });
    setClass(element, 'set', editor.joints !== null);
    const unit = angle.unit === 'deg' ? 'degrees' : 'rad';
    const note = editor.joints ? `goal in ${unit}` : `present positions in ${unit}: move a slider to set a goal`;
    const reaches = beyond && editor.joints?.[beyond.index] === beyond.goal ? `; ${beyond.text}` : '';
    setText(element.querySelector('.unit-note')!, note + reaches);
  };
  let key = '';
  context.run.onStatus.on(() => {
    // Limits are known after the first status and the planner's report.
    const now = JSON.stringify([editor.names, editor.names.map(limitsOf)]);
    if (now !== key) {
      key = now;
      build();
    } else if (!editor.joints) {
      show();
    }
  });
  context.onSelect.on(build);
  editor.changed.on(show);
  angle.changed.on(show);
  return element;
}
