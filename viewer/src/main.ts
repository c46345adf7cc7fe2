// The page: reads the token and the scene; of a run it puts the panels together.
import 'uplot/dist/uPlot.min.css';
import './style.css';
import './acts.css';
import './strip.css';
import {Context} from './context';
import {button, el, tabBar} from './dom';
import {pause} from './flow';
import {logPage} from './log/page';
import {modelPage} from './model/page';
import {armsPanel} from './panels/arms';
import {eventsPanel} from './panels/events';
import {header} from './panels/header';
import {jogPanel} from './panels/jog';
import {jointsPanel} from './panels/joints';
import {movePanel} from './panels/move';
import {notice} from './panels/notice';
import {plotsPanel} from './panels/plots';
import {strip} from './panels/strip';
import {timeline} from './panels/timeline';
import {toolbar} from './panels/toolbar';
import {worldPanel} from './panels/world';
import type {Scene} from './protocol';
import {Run} from './run';
import {Gizmo} from './scene/gizmo';
import {Stage} from './scene/stage';
import {View} from './scene/view';

const LONGEST_DELAY = 4000; // ms between two attempts to read the scene
const NO_ACTS_AFTER = 1500; // ms without a joint state
const app = document.getElementById('app')!;

async function main(): Promise<void> {
  window.addEventListener('hashchange', () => location.reload());
  const token = location.hash.slice(1);
  if (!token)
    return message('This address has no token', 'Open the address that the run prints when it starts: it ends with #…');
  const scene = await readScene(token);
  if (!scene) return;
  document.title = `${scene.name} · dimos`;
  if (scene.kind === 'log') return logPage(scene, token, app);
  if (scene.kind !== 'run') return modelPage(scene, token, app);
  const run = new Run(scene, `${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/rpc`, token);
  const context = new Context(run);
  const canvas = el('div', {class: 'canvas', id: 'view'});
  const stage = new Stage(canvas);
  context.gizmo = new Gizmo(stage);
  context.view = new View(stage, context, token);
  run.onJoints.on((state) => context.history.takeJoints(state));
  run.onPastJoints.on((state) => context.history.takePast(state));
  // While it is jogged the mode may be another one than that of the newest status.
  const follows = (arm: string) => !run.streaming && run.arm(arm)?.mode.endsWith('position') !== false;
  run.onState.on((state) => context.history.takeState(state, follows));
  layout(context, canvas);
  const usable = () => run.connected && run.age < NO_ACTS_AFTER;
  let enabled = false;
  enableActs(enabled);
  window.setInterval(() => {
    if (usable() === enabled) return;
    enabled = !enabled;
    enableActs(enabled);
  }, 100);
  // For tests: the objects drawn, and how long the page's own code took.
  Object.assign(window, {
    dimos: {measured: stage.measured, run, history: context.history, memory: stage.renderer.info.memory},
  });
  run.start();
}

/** Reads the scene, with retries until the run answers; null if it refuses the token. */
async function readScene(token: string): Promise<Scene | null> {
  for (let delay = 250; ; delay = Math.min(delay * 2, LONGEST_DELAY)) {
    try {
      const reply = await fetch('/scene.json', {headers: {Authorization: `Bearer ${token}`}});
      if (reply.ok) return (await reply.json()) as Scene;
      if (reply.status === 401) {
        message('The run refuses this token', 'Open the address that the run prints: each run has its own token');
        return null;
      }
      message('The run does not show itself', `${reply.status} ${await reply.text()}`);
    } catch {
      message('No connection to the run', `next attempt in ${delay / 1000} s`);
    }
    await pause(delay);
  }
}

function layout(context: Context, canvas: HTMLElement): void {
  const top = header(context);
  const offline = el('div', {
    class: 'offline-note',
    text: 'No connection: what you see is old, and nothing can be commanded',
  });
  const centre = el(
    'section',
    {class: 'centre'},
    canvas,
    toolbar(context),
    offline,
    notice(context),
    timeline(context),
  );
  const left = el(
    'aside',
    {class: 'left', attributes: {'data-panel': 'arms'}},
    armsPanel(context),
    jointsPanel(context),
  );
  const panels = el(
    'div',
    {class: 'panels'},
    movePanel(context),
    jogPanel(context),
    worldPanel(context),
    eventsPanel(context),
  );
  const names = [
    ['arms', 'Arms'],
    ['move', 'Move'],
    ['jog', 'Jog'],
    ['world', 'Obstacles'],
    ['events', 'Events'],
    ['plots', 'Plots'],
  ] as const;
  const tabs = tabBar(names, panels, () => {
    window.dispatchEvent(new Event('resize'));
    context.onTab.emit();
  });
  const licences = button('licences', () => (document.getElementById('licences') as HTMLDialogElement).show(), {
    class: 'quiet',
  });
  top.element.append(top.stop);
  const bar = el('div', {class: 'topbar'}, top.element, strip(context));
  left.append(el('footer', {}, el('span', {id: 'version'}), licences));
  context.run.onStatus.on(({version}) => {
    document.getElementById('version')!.textContent = `dimos ${version}`;
  });
  app.replaceChildren(bar, left, centre, plotsPanel(context), el('aside', {class: 'right'}, tabs.element, panels));
  tabs.choose('move');
}

/** Without a connection, or without data, nothing can be commanded. Stop is not among these. */
function enableActs(connected: boolean): void {
  document.querySelectorAll<HTMLFieldSetElement>('fieldset.acts').forEach((each) => {
    each.disabled = !connected;
  });
}

function message(title: string, text: string): void {
  app.replaceChildren(el('div', {class: 'message', id: 'message'}, el('h1', {text: title}), el('p', {text})));
}

void main();
