// The error of the last action, and its remedy.
import type {Context} from '../context';
import {button, el} from '../dom';

export function notice(context: Context): HTMLElement {
  const element = el('div', {class: 'notice hidden', id: 'notice', attributes: {role: 'alert'}});
  context.onNotice.on((notice) => {
    element.classList.toggle('hidden', !notice);
    if (!notice) return;
    element.replaceChildren(
      el('div', {}, el('div', {text: notice.text}), notice.hint ? el('div', {class: 'hint', text: notice.hint}) : null),
      button('✕', () => context.onNotice.emit(null), {class: 'small', title: 'Close'}),
    );
  });
  return element;
}
