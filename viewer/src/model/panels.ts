// Figures of a model at its joint positions: pairs that touch, tool centre points, limits, pairs never checked.
import type {Context} from '../context';
import {el, setText} from '../dom';
import {angle, angleText, figure} from '../units';
import type {Posed} from './posed';

export function checks(context: Context, run: Posed): HTMLElement {
  const verdict = el('p', {class: 'verdict', id: 'verdict', attributes: {role: 'status'}});
  const pairs = el('tbody', {id: 'pairs'});
  const head = el('tr', {}, el('th', {text: 'pair'}), el('th', {text: 'mm'}));
  const table = el('table', {class: 'pairs'}, el('thead', {}, head), pairs);
  const poses = el('div', {id: 'tcp'});
  // With one robot its name says nothing.
  const prefix = run.scene.robots.length === 1 ? `${run.scene.robots[0]!.name}/` : '';
  const own = (link: string) => (prefix && link.startsWith(prefix) ? link.slice(prefix.length) : link);
  const show = () => {
    const touching = run.pairs?.filter(({distance}) => distance <= 0).length ?? 0;
    verdict.dataset.level = run.trouble ? 'warn' : touching ? 'bad' : 'good';
    setText(
      verdict,
      run.trouble
        ? `Collisions are not checked: ${run.trouble}`
        : run.pairs === null
          ? 'checking…'
          : touching
            ? `${touching} ${touching === 1 ? 'pair touches' : 'pairs touch'}`
            : 'Nothing touches',
    );
    table.classList.toggle('hidden', !run.pairs?.length);
    pairs.replaceChildren(
      ...(run.pairs ?? []).map(({links: [a, b], distance}) =>
        el(
          'tr',
          {class: distance <= 0 ? 'touches' : ''},
          el('td', {}, el('div', {text: own(a)}), el('div', {text: own(b)})),
          el('td', {class: 'number', text: figure(distance * 1000, 1)}),
        ),
      ),
    );
    poses.replaceChildren(
      ...run.tcp.map(({robot, link, xyz, rpy}) =>
        el(
          'div',
          {},
          el('h3', {class: 'minor', text: run.tcp.length > 1 ? `${robot}: ${link}` : link}),
          el(
            'dl',
            {class: 'pose'},
            el('dt', {text: 'xyz'}),
            el('dd', {text: `${xyz.map((v) => figure(v, 4)).join('  ')} m`}),
            el('dt', {text: 'rpy'}),
            el('dd', {text: `${rpy.map(angleText).join('  ')} ${angle.label}`}),
          ),
        ),
      ),
    );
    const touched = new Set((run.pairs ?? []).filter(({distance}) => distance <= 0).flatMap(({links}) => links));
    for (const [name, robot] of context.view.robots) {
      robot.highlight((link) => touched.has(link) || touched.has(`${name}/${link}`));
    }
  };
  run.onReply.on(show);
  angle.changed.on(show);
  show();
  return el(
    'section',
    {attributes: {'data-panel': 'checks'}},
    el('h2', {text: 'Collisions'}),
    verdict,
    table,
    el('p', {class: 'minor', text: 'Distances of pairs closer than 50 mm; negative: penetration depth'}),
    el('h2', {text: 'Tool centre point'}),
    poses,
  );
}

export function limits(context: Context, run: Posed): HTMLElement {
  const body = el('tbody', {id: 'limits'});
  const units = el('p', {class: 'minor'});
  const show = () => {
    const rows = run.scene.robots.flatMap((robot) =>
      Object.keys(robot.joints).map((joint) => {
        const {lower, upper, velocity, acceleration} = robot.limits[joint] ?? {};
        const linear = context.view.robots.get(robot.name)!.isLinear(joint);
        const factor = linear ? 1 : angle.factor;
        const cell = (value: number | null | undefined, digits: number) =>
          el('td', {class: 'number', text: figure(typeof value === 'number' ? value * factor : null, digits)});
        const digits = linear ? 3 : angle.unit === 'deg' ? 0 : 2;
        return el(
          'tr',
          {},
          el('td', {text: joint, title: joint}),
          cell(lower, digits),
          cell(upper, digits),
          cell(velocity, digits),
          cell(acceleration, digits),
        );
      }),
    );
    body.replaceChildren(...rows);
    const unit = angle.label;
    setText(units, `${unit}, ${unit}/s, ${unit}/s²; m for prismatic joints. –: none given`);
  };
  angle.changed.on(show);
  show();
  const head = ['joint', 'lower', 'upper', 'speed', 'accel.'].map((text) => el('th', {text}));
  return el(
    'section',
    {attributes: {'data-panel': 'limits'}},
    el('h2', {text: 'Limits'}),
    el('table', {class: 'limits'}, el('thead', {}, el('tr', {}, ...head)), body),
    units,
  );
}

export function ignored(run: Posed): HTMLElement {
  const reasons = new Map<string, [string, string][]>();
  for (const [a, b, why] of run.model.ignored) reasons.set(why, [...(reasons.get(why) ?? []), [a, b]]);
  const groups = [...reasons].map(([why, pairs]) =>
    el(
      'details',
      // Long lists are closed at first; what may be a mistake is not.
      pairs.length < 12 || /every/.test(why) ? {attributes: {open: ''}} : {},
      el('summary', {text: `${why} (${pairs.length})`}),
      el('ul', {}, ...pairs.map(([a, b]) => el('li', {text: `${a} · ${b}`}))),
    ),
  );
  return el(
    'section',
    {attributes: {'data-panel': 'ignored'}, id: 'ignored'},
    el('h2', {text: 'Pairs that are never checked'}),
    ...(groups.length ? groups : [el('p', {class: 'minor', text: 'none'})]),
  );
}
