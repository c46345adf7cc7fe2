// The page of a log: its arms as they moved, the plans next to the motions, plots, events.
import '../files.css';
import {Context} from '../context';
import {el, setClass, setText} from '../dom';
import {frame, makeView} from '../frame';
import {armsPanel} from '../panels/arms';
import {jointsPanel} from '../panels/joints';
import type {Preview, Scene} from '../protocol';
import {Server} from '../server';
import {clock, duration, figure} from '../units';
import {bar} from './bar';
import {Player} from './player';
import {logPlots} from './plots';
import {type LogScene, LogSource} from './source';
import {type Motion, Story} from './story';
import {Trails} from './trails';

const SHOWN = 400; // events
/** Without a motion, the way of the last seconds is shown. */
const TRAIL = 3;

export function logPage(scene: Scene, token: string, app: HTMLElement): void {
  const log = scene as LogScene;
  driveAllJoints(log);
  const source = new LogSource(log, new Server(token));
  const story = new Story(source);
  const player = new Player(source, story);
  const context = new Context(player);
  const canvas = makeView(context, token);
  const trails = new Trails(context.view.stage);
  context.view.showTraces = (on) => trails.show(on);
  player.onTime.on(() => showMotion(context, player, trails));
  const about = el('div', {class: 'about', id: 'about'});
  const describe = () => {
    const state = source.live ? 'live' : source.loss ? `not whole: ${source.loss}` : 'complete';
    const began = new Date(log.log.start * 1000).toLocaleString();
    const known = [log.log.file, began, duration(source.length * 1000), state].join(' · ');
    setText(about, player.trouble || known);
    setClass(about, 'bad', player.trouble !== '');
  };
  player.onTime.on(describe);
  describe();
  const noRobot = el('p', {class: 'minor', text: 'This log has no robot description: only joints are shown.'});
  app.replaceChildren(
    ...frame(context, {
      badge: 'LOG',
      badgeTitle: 'What was recorded: nothing is connected',
      about,
      canvas,
      foot: bar(player),
      left: [...(scene.robots.length ? [] : [el('section', {}, noRobot)]), armsPanel(context), jointsPanel(context)],
      leftTab: 'Arms',
      plots: logPlots(context, player),
      tabs: [['events', 'Events', events(player)]],
    }),
  );
  // For tests: the state shown.
  Object.assign(window, {player});
  void story.begin().catch((error) => context.report(error));
  player.seek(0);
}

/** The joints of the description have the names of `/joint_states`, grippers too. */
function driveAllJoints(scene: LogScene): void {
  for (const robot of scene.robots) {
    const urdf = new DOMParser().parseFromString(robot.urdf, 'text/xml');
    for (const joint of urdf.querySelectorAll('robot > joint:not([type=fixed])')) {
      const name = joint.getAttribute('name')!;
      if (!joint.querySelector('mimic')) robot.joints[name] = name;
    }
  }
}

/** The plan as a line with the arm at its end, and the way that was taken. */
function showMotion({view}: Context, player: Player, trails: Trails): void {
  const motions = player.story.motionsAt(player.time);
  const from = motions.length ? Math.min(...motions.map(({start}) => start)) : player.time - TRAIL;
  trails.draw(player.ways(from, player.time));
  const key = motions.map(({start}) => start).join();
  if (key === trails.key) return;
  trails.key = key;
  const preview = motions.length ? previewOf(motions) : null;
  view.showPlanLine(preview);
  view.showPlan(preview, preview?.summary.duration ?? 0);
}

function previewOf(motions: Motion[]): Preview {
  const joints = motions.flatMap(({joints}) => joints);
  const positions = motions.flatMap(({points}) => points.at(-1)?.positions ?? []);
  const lines = motions.flatMap(({lines}) => lines);
  return {
    plan: 0,
    summary: {joints, start: [], goal: positions, duration: 0, length: 0, clearance: null, closest: null},
    trajectory: {joint_names: joints, points: [{time_from_start: 0, positions}]},
    end_effectors: Object.fromEntries(lines.map((line, i) => [String(i), line])),
  };
}

function events(player: Player): HTMLElement {
  const {story, source} = player;
  const list = el('ol', {class: 'events', id: 'events'});
  const note = el('p', {class: 'minor'});
  let shown: {t: number; item: HTMLElement}[] = [];
  const fill = () => {
    // Of very many, those that are no answers to requests.
    const all = story.events.length > SHOWN ? story.events.filter(({data}) => data.severity !== 'info') : story.events;
    shown = all.slice(0, SHOWN).map(({t, data}) => {
      const item = el(
        'li',
        {class: `${data.severity === 'warn' ? 'warning' : data.severity} seekable`, onclick: () => player.seek(t)},
        el('time', {text: `${figure(t, 2)} s`, title: clock(new Date((source.scene.log.start + t) * 1000))}),
        el('span', {text: data.by ? `${data.text}, by ${data.by}` : data.text}),
      );
      return {t, item};
    });
    list.replaceChildren(...shown.map(({item}) => item));
    setText(
      note,
      shown.length === story.events.length
        ? `${shown.length} events: a click goes to its time`
        : `${shown.length} of ${story.events.length} events: warnings and errors, the first ${SHOWN}`,
    );
    mark();
  };
  const mark = () => {
    for (const {t, item} of shown) setClass(item, 'future', t > player.time + 1e-6);
  };
  story.changed.on(fill);
  player.onTime.on(mark);
  return el('section', {attributes: {'data-panel': 'events'}}, el('h2', {text: 'Events'}), note, list);
}
