// The frame of a page that shows a file: header, view, panels with their tabs. Nothing of it can command an arm.
import type {Context} from './context';
import {button, el, tabBar} from './dom';
import {notice} from './panels/notice';
import {toolbar} from './panels/toolbar';
import {Stage} from './scene/stage';
import {View} from './scene/view';

/** The 3D view of a page without handles. */
export function makeView(context: Context, token: string): HTMLElement {
  const canvas = el('div', {class: 'canvas', id: 'view'});
  const stage = new Stage(canvas);
  context.view = new View(stage, context, token);
  // For tests: the objects drawn.
  Object.assign(window, {dimos: {measured: stage.measured, run: context.run, memory: stage.renderer.info.memory}});
  return canvas;
}

interface Parts {
  /** What is shown: `LOG`, `MODEL`. */
  badge: string;
  badgeTitle: string;
  about: HTMLElement;
  canvas: HTMLElement;
  /** Over the lower edge of the view. */
  foot: HTMLElement | null;
  left: HTMLElement[];
  plots: HTMLElement | null;
  /** Panels on the right: name of the tab, its text, the panel. */
  tabs: (readonly [string, string, HTMLElement])[];
  /** What a phone calls the left column. */
  leftTab: string;
}

export function frame(context: Context, parts: Parts): HTMLElement[] {
  const {badge, badgeTitle, about, canvas, foot, left, plots, leftTab} = parts;
  document.body.classList.add('file');
  const header = el(
    'header',
    {},
    el(
      'div',
      {class: 'title'},
      el('strong', {text: context.run.scene.name}),
      el('span', {class: 'badge simulated', id: 'banner', text: badge, title: badgeTitle}),
    ),
    about,
  );
  const centre = el('section', {class: 'centre'}, canvas, toolbar(context, plots !== null), notice(context), foot);
  const column = el('aside', {class: 'left', attributes: {'data-panel': 'arms'}}, ...left);
  const licences = button('licences', () => (document.getElementById('licences') as HTMLDialogElement).show(), {
    class: 'quiet',
  });
  column.append(el('footer', {}, el('span', {text: 'Nothing here moves an arm'}), licences));
  const panels = el('div', {class: 'panels'}, ...parts.tabs.map(([, , panel]) => panel));
  const names: (readonly [string, string])[] = [
    ['arms', leftTab],
    ...parts.tabs.map(([name, text]) => [name, text] as const),
    ...(plots ? [['plots', 'Plots'] as const] : []),
  ];
  const narrow = matchMedia('(max-width: 960px)');
  const tabs = tabBar(names, panels, (tab) => {
    // On a desktop the other columns are always there.
    const shown = parts.tabs.some(([name]) => name === tab) || narrow.matches ? tab : parts.tabs[0]![0];
    for (const [name, , panel] of parts.tabs) panel.classList.toggle('hidden', name !== shown);
    window.dispatchEvent(new Event('resize'));
  });
  tabs.choose(narrow.matches ? 'arms' : parts.tabs[0]![0]);
  narrow.addEventListener('change', () => tabs.choose(document.body.dataset.tab!));
  return [header, column, centre, ...(plots ? [plots] : []), el('aside', {class: 'right'}, tabs.element, panels)];
}
