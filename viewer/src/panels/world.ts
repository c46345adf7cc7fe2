// Obstacles: a list with moving and removing by hand, and a form for new ones.
import type {Context} from '../context';
import {button, choice, el, NumberField, setClass} from '../dom';
import type {Shape, Vec3, WorldObject} from '../protocol';
import type {Handles} from '../scene/gizmo';
import {place} from '../scene/obstacles';
import {figure} from '../units';

type Kind = 'box' | 'sphere' | 'cylinder';

export function worldPanel(context: Context): HTMLElement {
  const {run} = context;
  const list = el('ul', {class: 'objects', id: 'objects'});
  const moving = movePart(context);
  let key = '';
  const show = () => {
    const now = JSON.stringify([run.world, moving.name()]);
    if (now === key) return;
    key = now;
    list.replaceChildren(
      ...run.world.map((object) => {
        const held = object.held_by;
        const row = el(
          'li',
          {attributes: {'data-object': object.name}},
          el(
            'div',
            {},
            el('strong', {text: object.name}),
            el('span', {class: 'minor', text: held ? `held by ${held.join('/')}` : shapeText(object.shape)}),
          ),
          button('Move', () => moving.start(object), {class: 'small'}),
          button(
            'Remove',
            async () => {
              if (await context.act('world_remove', {name: object.name})) await run.readWorld().catch(() => {});
            },
            {class: 'small danger'},
          ),
        );
        if (held)
          row.querySelectorAll('button').forEach((each) => {
            each.disabled = true;
          });
        setClass(row, 'selected', moving.name() === object.name);
        return row;
      }),
    );
    if (!run.world.length) list.replaceChildren(el('li', {class: 'minor', text: 'no obstacles'}));
  };
  run.onWorld.on(show);
  moving.changed(show);
  const body = run.scene.planner
    ? [el('fieldset', {class: 'acts'}, list, moving.element), addPart(context)]
    : [el('p', {class: 'note', text: 'This run has no planner, so it has no obstacles.'})];
  return el('section', {class: 'world', attributes: {'data-panel': 'world'}}, el('h2', {text: 'Obstacles'}), ...body);
}

/** Moves an obstacle with the handles; nothing changes before Apply. */
function movePart(context: Context) {
  let current: WorldObject | null = null;
  let handles: Handles = 'translate';
  const listeners: (() => void)[] = [];
  const end = () => {
    const object = current && context.view.obstacles.get(current.name);
    if (object && current) place(object, current.pose);
    context.gizmo.detach();
    context.view.obstacles.held = current = null;
    element.classList.add('hidden');
    for (const listener of listeners) listener();
  };
  const attach = () => {
    const object = current && context.view.obstacles.get(current.name);
    if (object) context.gizmo.attach(object, handles, () => {});
  };
  const apply = button(
    'Apply',
    async () => {
      const object = current && context.view.obstacles.get(current.name);
      if (!object || !current) return end();
      const pose = {xyz: object.position.toArray(), quat: object.quaternion.toArray()};
      const name = current.name;
      const done = await context.act('world_move', {name, pose});
      if (done) current.pose = {xyz: pose.xyz, quat: pose.quat as [number, number, number, number]};
      end();
      await context.run.readWorld().catch(() => {});
    },
    {class: 'primary'},
  );
  const mode = choice<Handles>(
    [
      ['translate', 'Shift'],
      ['rotate', 'Turn'],
    ],
    'translate',
    (value) => {
      handles = value;
      attach();
    },
  );
  const element = el('div', {class: 'row hidden'}, mode.element, apply, button('Revert', end));
  return {
    element,
    name: () => current?.name ?? null,
    changed: (listener: () => void) => listeners.push(listener),
    start: (object: WorldObject) => {
      if (current) end();
      current = structuredClone(object);
      context.view.obstacles.held = object.name;
      element.classList.remove('hidden');
      attach();
      for (const listener of listeners) listener();
    },
  };
}

function addPart(context: Context): HTMLElement {
  let kind: Kind = 'box';
  const name = el('input', {
    id: 'object-name',
    attributes: {placeholder: 'name', 'aria-label': 'name of the obstacle', maxlength: '40'},
  });
  const field = (label: string, value: number) => new NumberField(label, 'm', value, 0.01);
  const sizes: Record<Kind, NumberField[]> = {
    box: [field('x', 0.1), field('y', 0.1), field('z', 0.2)],
    sphere: [field('radius', 0.05)],
    cylinder: [field('radius', 0.04), field('length', 0.2)],
  };
  const at = [field('x', 0.4), field('y', 0), field('z', 0.1)];
  const size = el('div', {class: 'grid3'});
  const show = () => size.replaceChildren(...sizes[kind].map((each) => each.element));
  const shape = (): Shape => {
    const [a, b, c] = sizes[kind].map((each) => each.value);
    return kind === 'box' ? {box: [a!, b!, c!]} : kind === 'sphere' ? {sphere: a!} : {cylinder: [a!, b!]};
  };
  const add = button(
    'Add',
    async () => {
      const given = name.value.trim() || nextName(kind, context.run.world);
      if (context.run.world.some((object) => object.name === given)) {
        // The run would replace it.
        const hint = `give another name; or remove ${given} first`;
        return context.onNotice.emit({text: `there is an obstacle named ${given}`, hint});
      }
      const pose = {xyz: at.map((each) => each.value) as Vec3};
      if (await context.act('world_add', {name: given, shape: shape(), pose})) {
        name.value = '';
        await context.run.readWorld().catch(() => {});
      }
    },
    {id: 'object-add', class: 'primary'},
  );
  show();
  return el(
    'fieldset',
    {class: 'acts add'},
    el('h3', {text: 'New obstacle'}),
    choice<Kind>(
      [
        ['box', 'Box'],
        ['sphere', 'Sphere'],
        ['cylinder', 'Cylinder'],
      ],
      'box',
      (value) => {
        kind = value;
        show();
      },
    ).element,
    el('span', {class: 'minor', text: 'size'}),
    size,
    el('span', {class: 'minor', text: 'centre in map'}),
    el('div', {class: 'grid3', id: 'object-at'}, ...at.map((each) => each.element)),
    el('div', {class: 'row'}, name, add),
  );
}

function nextName(kind: string, world: WorldObject[]): string {
  for (let n = 1; ; n++) if (!world.some((object) => object.name === `${kind}${n}`)) return `${kind}${n}`;
}

function shapeText(shape: Shape): string {
  const list = (values: number[]) => values.map((value) => figure(value, 3)).join(' × ');
  if ('box' in shape) return `box ${list(shape.box)} m`;
  if ('sphere' in shape) return `sphere, radius ${list([shape.sphere])} m`;
  if ('cylinder' in shape) return `cylinder, radius × length ${list(shape.cylinder)} m`;
  return 'mesh' in shape ? `mesh ${shape.mesh} (not shown)` : `cloud ${shape.cloud} (not shown)`;
}
