// The motion panel: a goal, then Plan, Preview, Execute and Cancel. Only Execute (or Move, without a planner) moves.
import type {Context} from '../context';
import {button, choice, el, setClass, setText, setValueText} from '../dom';
import {GoalEditor, type Mode} from '../goal';
import {figure} from '../units';
import {goalsPart} from './goals';
import {gripperPanel} from './gripper';
import {poseFields} from './pose';
import {savePose} from './save';
import {jointSliders} from './sliders';

export function movePanel(context: Context): HTMLElement {
  const {run, flow} = context;
  const editor = new GoalEditor(context);
  const planned = () => run.scene.planner && run.planner?.robots.some((robot) => robot.name === editor.robot?.name);
  const title = el('h2');
  const modes = choice<Mode>(
    [
      ['joints', 'Joints'],
      ['pose', 'Pose'],
    ],
    'joints',
    (mode) => editor.setMode(mode),
  );
  const named = el('div', {class: 'chips', id: 'named'});
  const sliders = jointSliders(context, editor);
  const pose = poseFields(editor);
  const goals = goalsPart(context, editor);
  const speed = el('input', {
    id: 'plan-speed',
    attributes: {type: 'range', min: '5', max: '100', value: '50', 'aria-label': 'speed of the next motion'},
  });
  const speedText = el('output', {text: '50 %'});
  setValueText(speed, '50 %');
  speed.addEventListener('input', () => {
    setText(speedText, `${speed.value} %`);
    setValueText(speed, speedText.textContent);
  });
  const fraction = () => Number(speed.value) / 100;

  const plan = button(
    'Plan',
    () => {
      const request = editor.request(fraction());
      if (typeof request === 'string') return context.onNotice.emit({text: request});
      context.onNotice.emit(null);
      editor.hide();
      void flow.makePlan(editor.arms, request);
    },
    {id: 'plan', class: 'primary'},
  );
  const direct = button(
    'Move',
    () => {
      const target = editor.joints;
      if (target) void flow.moveDirect(context.selected, target, fraction());
    },
    {id: 'direct', class: 'go', title: 'Moves the arm: in joint space, not collision-checked'},
  );
  const preview = button('Preview', () => flow.onPlay.emit(), {
    id: 'preview',
  });
  const execute = button('Execute', () => void flow.execute(), {
    id: 'execute',
    class: 'go',
    title: 'Moves the arm along the plan',
  });
  const cancel = button(
    'Cancel',
    () => {
      flow
        .cancel(flow.arms[0] && flow.busy ? flow.arms[0] : context.selected)
        .catch((error: unknown) => context.report(error));
    },
    {id: 'cancel', title: 'Ends planning, or decelerates the motion to rest'},
  );
  const clear = button(
    'Clear goal',
    () => {
      flow.clear();
      editor.clear();
    },
    {id: 'clear'},
  );
  const report = el('div', {class: 'report', id: 'report', attributes: {role: 'status'}});
  const warning = el('p', {
    class: 'note warn',
    text: 'No planner: motions are direct, in joint space, and not collision-checked.',
  });

  const show = () => {
    const withPlanner = planned();
    const executing = run.status?.tasks.some(
      (task) => task.state === 'EXECUTING' && task.joints.some((joint) => context.arm?.joints.includes(joint)),
    );
    setText(title, run.scene.arms.length > 1 ? `Move ${context.selected}` : 'Move');
    setClass(modes.element, 'hidden', !withPlanner);
    setClass(sliders, 'hidden', editor.mode !== 'joints');
    setClass(named, 'hidden', editor.mode !== 'joints');
    setClass(pose, 'hidden', editor.mode !== 'pose');
    setClass(warning, 'hidden', !!withPlanner);
    setClass(goals, 'hidden', !withPlanner);
    for (const each of [plan, preview, execute]) setClass(each, 'hidden', !withPlanner);
    setClass(direct, 'hidden', !!withPlanner);
    plan.disabled = flow.busy || !editor.arms.length;
    setText(plan, editor.arms.length > 2 ? 'Plan all' : editor.arms.length > 1 ? 'Plan both' : 'Plan');
    direct.disabled = flow.busy || !editor.joints;
    preview.disabled = flow.stage !== 'planned';
    execute.disabled = flow.stage !== 'planned';
    cancel.disabled = !flow.busy && !executing;
    clear.disabled = flow.busy;
    showReport(report, context);
  };
  const showNamed = () => {
    named.replaceChildren(
      ...[...editor.namedPoses().keys()].map((name) => {
        const chip = button(name, () => editor.setNamed(name), {attributes: {'data-pose': name}});
        chip.setAttribute('aria-pressed', String(editor.named === name));
        return chip;
      }),
    );
  };
  // A new goal replaces the plan of the old one.
  editor.onEdit.on(() => flow.clear());
  editor.changed.on(() => {
    showNamed();
    show();
  });
  let stage = flow.stage;
  flow.changed.on(() => {
    if (flow.stage !== stage) {
      stage = flow.stage;
      if (stage === 'ended') editor.clear();
      else if (stage === 'failed') editor.show();
    }
    show();
  });
  run.onStatus.on(show);
  run.onPoses.on(showNamed);
  context.onSelect.on(() => {
    // A plan that moves the selected arm stays.
    if (!flow.arms.includes(context.selected)) flow.clear();
    modes.choose(editor.mode);
    showNamed();
    show();
  });
  showNamed();
  show();

  return el(
    'section',
    {class: 'move', attributes: {'data-panel': 'move'}},
    el(
      'fieldset',
      {class: 'acts'},
      el('div', {class: 'section-head'}, title, modes.element),
      warning,
      named,
      sliders,
      pose,
      goals,
      el('label', {class: 'slider plain'}, el('span', {text: 'speed'}), speed, speedText),
      el('div', {class: 'buttons'}, plan, preview, execute, direct, cancel, clear),
      report,
    ),
    el('fieldset', {class: 'acts'}, savePose(context)),
    gripperPanel(context),
  );
}

function showReport(report: HTMLElement, {flow}: Context): void {
  const lines: HTMLElement[] = [];
  const line = (level: string, text: string) => lines.push(el('div', {class: level, text}));
  const who = flow.arms.length > 1 && flow.stage !== 'idle' ? `${flow.arms.join(' and ')}: ` : '';
  if (flow.text) line(flow.stage === 'failed' ? 'bad' : flow.stage === 'ended' ? 'good' : '', who + flow.text);
  if (flow.error?.hint) line('hint', flow.error.hint);
  const summary = flow.stage === 'planned' || flow.stage === 'executing' ? flow.preview?.summary : null;
  if (summary) {
    const clearance =
      typeof summary.clearance !== 'number'
        ? ''
        : ` · clearance ≥ ${figure(summary.clearance * 1000, summary.clearance < 1e-3 ? 3 : 1)} mm` +
          (summary.closest ? ` (${summary.closest.join(' – ')})` : '');
    line('', `${figure(summary.duration, 1)} s · ${figure(summary.length, 2)} rad${clearance}`);
    if (typeof summary.fraction === 'number' && summary.fraction < 1) {
      line('warn', `only ${Math.round(summary.fraction * 100)} % of the straight line is feasible`);
    }
  }
  report.replaceChildren(...lines);
}
