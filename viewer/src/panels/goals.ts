// Goals that are planned together: the goals of several arms, or the waypoints before the goal of one.
import type {Context} from '../context';
import {button, el, NumberField, setClass} from '../dom';
import type {GoalEditor} from '../goal';

export function goalsPart(context: Context, editor: GoalEditor): HTMLElement {
  const several = context.run.scene.arms.length > 1;
  const goals = el('div', {class: 'chips', id: 'goals'});
  const waypoints = el('ol', {class: 'waypoints', id: 'waypoints'});
  const blend = new NumberField('blend', 'mm', 0, 5, (value) => {
    // 0: it stops at each.
    editor.blend = Number.isFinite(value) ? Math.min(1, Math.max(0, value / 1000)) : 0;
    editor.onEdit.emit();
  });
  blend.input.id = 'blend';
  blend.element.title = 'How far away the tool centre point may pass the waypoints; 0: it stops at each';
  const add = button('Add waypoint', () => editor.addWaypoint(), {
    id: 'waypoint-add',
    class: 'small',
    title: 'Keeps this goal as a waypoint: the motion passes it before the next goal',
  });
  const remove = (text: string, title: string, act: () => void) => {
    const element = button(`${text} ✕`, act, {title});
    return element;
  };
  const show = () => {
    goals.replaceChildren(
      ...(several ? editor.arms : [])
        .filter((arm) => arm !== context.selected || editor.arms.length > 1)
        .map((arm) => remove(`${arm}: ${editor.text(arm)}`, `Drops the goal of ${arm}`, () => editor.drop(arm))),
    );
    waypoints.replaceChildren(
      ...editor.waypoints.map(({text}, index) =>
        el(
          'li',
          {},
          el('span', {text}),
          button('✕', () => editor.removeWaypoint(index), {class: 'small', title: 'Removes this waypoint'}),
        ),
      ),
    );
    setClass(blend.element, 'hidden', !editor.waypoints.length);
    add.disabled = !editor.goal();
  };
  editor.changed.on(show);
  context.onSelect.on(show);
  show();
  return el('div', {class: 'goals'}, goals, waypoints, el('div', {class: 'row'}, add, blend.element));
}
