// Saves where the arm is under a name, for later goals and waypoints.
import type {Context} from '../context';
import {button, el} from '../dom';

export function savePose(context: Context): HTMLElement {
  const name = el('input', {
    attributes: {placeholder: 'name of the present pose', 'aria-label': 'name of the pose', maxlength: '40'},
  });
  const save = button(
    'Save',
    async () => {
      if (!name.value.trim()) return name.focus();
      if (await context.act('pose_save', {name: name.value.trim(), arms: [context.selected]})) {
        name.value = '';
        await context.run.readPoses().catch(() => {});
      }
    },
    {title: 'Saves the measured joint positions: a named pose for later goals'},
  );
  return el('div', {class: 'row save'}, name, save);
}
