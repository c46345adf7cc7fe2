// Figures of a pose goal, beside the handles in the view.
import {choice, el, NumberField, setClass, setText} from '../dom';
import type {GoalEditor} from '../goal';
import type {Handles} from '../scene/gizmo';
import {angle} from '../units';

export function poseFields(editor: GoalEditor): HTMLElement {
  const read = () => {
    const values = [...lengths, ...angles].map((field) => field.value);
    if (!values.every(Number.isFinite)) return;
    const [x, y, z, r, p, w] = values as [number, number, number, number, number, number];
    const factor = angle.factor;
    editor.setPose([x, y, z], [r / factor, p / factor, w / factor]);
  };
  const lengths = ['x', 'y', 'z'].map((name) => new NumberField(name, 'm', 0, 0.01, read));
  const angles = ['roll', 'pitch', 'yaw'].map((name) => new NumberField(name, '', 0, 0.05, read));
  const handles = choice<Handles>(
    [
      ['translate', 'Shift'],
      ['rotate', 'Turn'],
    ],
    'translate',
    (value) => editor.setHandles(value),
  );
  const check = (text: string, title: string, onChange: (on: boolean) => void) => {
    const box = el('input', {attributes: {type: 'checkbox'}});
    box.addEventListener('change', () => onChange(box.checked));
    return el('label', {class: 'check', title}, box, el('span', {text}));
  };
  const note = el('p', {class: 'minor'});
  const reach = el('div', {class: 'note', id: 'reach', attributes: {role: 'status'}});
  const show = () => {
    const {xyz, rpy} = editor.pose();
    setText(
      note,
      `tool centre point in map, rpy in ${angle.unit === 'deg' ? 'degrees' : 'rad'}: drag the handles, or type`,
    );
    lengths.forEach((field, i) => {
      if (document.activeElement !== field.input) field.value = xyz[i]!;
    });
    angles.forEach((field, i) => {
      if (document.activeElement !== field.input) field.value = rpy[i]! * angle.factor;
    });
  };
  const showReach = () => {
    const {problem, joints, touches} = editor.reach;
    setClass(reach, 'hidden', !editor.edited || (!problem && !joints));
    setClass(reach, 'bad', problem !== null);
    const way = touches ? `${problem}: Plan looks for other joint positions of this pose` : problem;
    setText(reach, way ?? 'reachable: the ghost is the goal');
  };
  editor.changed.on(showReach);
  editor.changed.on(show);
  angle.changed.on(show);
  return el(
    'div',
    {class: 'pose-fields'},
    handles.element,
    el('div', {class: 'grid3'}, ...lengths.map((f) => f.element), ...angles.map((f) => f.element)),
    note,
    reach,
    el(
      'div',
      {class: 'row'},
      check('free orientation', 'The planner chooses the orientation', (on) => {
        editor.setFreeOrientation(on);
      }),
      check('straight line', 'The tool centre point moves on a straight line', (on) => {
        editor.setLinear(on);
      }),
    ),
  );
}
