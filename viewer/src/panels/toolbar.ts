// Buttons over the view: where the camera looks from, and what is shown.
import type {Context} from '../context';
import {button, el} from '../dom';
import type {Robot} from '../scene/robot';
import {VIEWS} from '../scene/stage';

const NAMES: Record<keyof typeof VIEWS, string> = {iso: 'Fit', front: 'Front', side: 'Side', top: 'Top'};

export function toolbar({view}: Context, traced = true): HTMLElement {
  const toggle = (text: string, title: string, on: boolean, set: (on: boolean) => void) => {
    const control = button(
      text,
      () => {
        const now = control.getAttribute('aria-pressed') !== 'true';
        control.setAttribute('aria-pressed', String(now));
        set(now);
      },
      {title, attributes: {'aria-pressed': String(on)}},
    );
    return control;
  };
  const each = (set: (robot: Robot) => void) => view.robots.forEach(set);
  return el(
    'div',
    {class: 'toolbar'},
    el(
      'div',
      {class: 'choice'},
      ...(Object.keys(VIEWS) as (keyof typeof VIEWS)[]).map((key) =>
        button(NAMES[key], () => view.stage.look(key), {attributes: {'data-view': key}}),
      ),
    ),
    el(
      'div',
      {class: 'choice'},
      traced ? toggle('Trace', 'Way of the tool centre points', true, (on) => view.showTraces(on)) : null,
      toggle('Frames', 'Frame of every link', false, (on) => each((robot) => robot.showFrames(on))),
      toggle('Collision', 'Collision geometry', false, (on) => each((robot) => robot.showColliders(on))),
      toggle('Grid', 'Grid and frame of map: 0.1 m', true, (on) => view.stage.setGrid(on)),
    ),
  );
}
