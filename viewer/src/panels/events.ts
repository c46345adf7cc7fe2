// Events of the run, the newest first.
import type {Context} from '../context';
import {el} from '../dom';
import type {RunEvent} from '../protocol';
import {clock} from '../units';

const SHOWN = 200;

export function eventsPanel(context: Context): HTMLElement {
  const none = el('li', {class: 'minor', text: 'none yet'});
  const list = el('ol', {class: 'events', id: 'events'}, none);
  const add = (event: RunEvent) => {
    none.remove();
    list.prepend(
      el(
        'li',
        {class: event.level},
        el('time', {text: clock(new Date(event.stamp * 1000))}),
        el('span', {text: event.by ? `${event.text}, by ${event.by}` : event.text}),
      ),
    );
    while (list.children.length > SHOWN) list.lastElementChild!.remove();
  };
  context.run.onEvent.on(add);
  return el('section', {attributes: {'data-panel': 'events'}}, el('h2', {text: 'Events'}), list);
}
