// The page of a robot model or a blueprint: joints by sliders, what touches, limits. No hardware.
import '../files.css';
import {Context} from '../context';
import {el} from '../dom';
import {frame, makeView} from '../frame';
import type {Scene} from '../protocol';
import {Server} from '../server';
import {checks, ignored, limits} from './panels';
import {type ModelScene, Posed} from './posed';
import {sliders} from './sliders';

export function modelPage(scene: Scene, token: string, app: HTMLElement): void {
  const run = new Posed(scene as ModelScene, new Server(token));
  const context = new Context(run);
  const canvas = makeView(context, token);
  // From one position of a slider to the next is no way.
  context.view.showTraces(false);
  const joints = scene.robots.reduce((sum, robot) => sum + Object.keys(robot.joints).length, 0);
  const count = (n: number, what: string) => `${n} ${what}${n === 1 ? '' : 's'}`;
  const objects = run.model.objects.length;
  const about = [
    count(scene.robots.length, 'robot'),
    count(joints, 'joint'),
    ...(objects ? [count(objects, 'obstacle')] : []),
    'no hardware',
  ];
  app.replaceChildren(
    ...frame(context, {
      badge: scene.kind === 'model' ? 'MODEL' : 'BLUEPRINT',
      badgeTitle: 'Nothing is connected',
      about: el('div', {class: 'about', text: about.join(' · ')}),
      canvas,
      foot: null,
      left: scene.robots.map((robot) => sliders(context, run, robot)),
      leftTab: 'Joints',
      plots: null,
      tabs: [
        ['checks', 'Collisions', checks(context, run)],
        ['limits', 'Limits', limits(context, run)],
        ['ignored', 'Ignored', ignored(run)],
      ],
    }),
  );
  run.start();
}
