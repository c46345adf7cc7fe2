// Elements in one expression, and texts that touch the page only when they change.

type Child = Node | string | null | false | undefined;
interface Options {
  class?: string;
  text?: string;
  title?: string;
  id?: string;
  onclick?: (event: MouseEvent) => void;
  attributes?: Record<string, string>;
}

export function el<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  options: Options = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  if (options.class) element.className = options.class;
  if (options.text !== undefined) element.textContent = options.text;
  if (options.title) element.title = options.title;
  if (options.id) element.id = options.id;
  if (options.onclick) element.addEventListener('click', options.onclick as EventListener);
  for (const [name, value] of Object.entries(options.attributes ?? {})) element.setAttribute(name, value);
  element.append(...children.filter((child): child is Node | string => !!child));
  return element;
}

export function button(text: string, onclick: () => void, options: Options = {}): HTMLButtonElement {
  return el('button', {...options, text, onclick, attributes: {type: 'button', ...options.attributes}});
}

export function setText(element: Element, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

/** The value of a slider as a screen reader says it: not the steps of the element. */
export function setValueText(range: HTMLInputElement, text: string): void {
  if (range.getAttribute('aria-valuetext') !== text) range.setAttribute('aria-valuetext', text);
}

export function setClass(element: Element, name: string, on: boolean): void {
  if (element.classList.contains(name) !== on) element.classList.toggle(name, on);
}

/** A number field with a label and a unit. */
export class NumberField {
  readonly input: HTMLInputElement;
  readonly element: HTMLElement;

  constructor(label: string, unit: string, value: number, step: number, onChange: (value: number) => void = () => {}) {
    this.input = el('input', {attributes: {type: 'number', step: String(step), inputmode: 'decimal'}});
    this.value = value;
    this.input.addEventListener('input', () => onChange(this.value));
    this.element = el(
      'label',
      {class: 'field'},
      el('span', {text: label}),
      this.input,
      unit ? el('span', {class: 'unit', text: unit}) : null,
    );
  }

  get value(): number {
    return this.input.valueAsNumber;
  }

  set value(value: number) {
    this.input.value = String(Number(value.toFixed(4)));
  }
}

/** Buttons of which one is chosen. */
export function choice<T extends string>(
  values: readonly (readonly [T, string])[],
  chosen: T,
  onChange: (value: T) => void,
): {element: HTMLElement; choose(value: T): void} {
  const buttons = new Map<T, HTMLButtonElement>();
  const choose = (value: T) => {
    for (const [key, each] of buttons) each.setAttribute('aria-pressed', String(key === value));
  };
  for (const [value, text] of values) {
    buttons.set(
      value,
      button(
        text,
        () => {
          choose(value);
          onChange(value);
        },
        {attributes: {'data-value': value}},
      ),
    );
  }
  choose(chosen);
  return {element: el('div', {class: 'choice'}, ...buttons.values()), choose};
}

/** The tabs of a page, and what they choose; the arrow keys go from one to the next. */
export function tabBar(
  names: readonly (readonly [string, string])[],
  panels: HTMLElement,
  onChoose: (name: string) => void,
): {element: HTMLElement; choose(name: string): void} {
  panels.setAttribute('role', 'tabpanel');
  const choose = (name: string) => {
    document.body.dataset.tab = name;
    panels.scrollTop = 0;
    for (const each of tabs) {
      const chosen = each.dataset.tab === name;
      each.setAttribute('aria-selected', String(chosen));
      each.tabIndex = chosen ? 0 : -1;
      if (chosen) panels.setAttribute('aria-labelledby', each.id);
    }
    onChoose(name);
  };
  const tabs = names.map(([name, text]) =>
    button(text, () => choose(name), {id: `tab-${name}`, attributes: {role: 'tab', 'data-tab': name}}),
  );
  const element = el('div', {class: 'tabs', attributes: {role: 'tablist'}}, ...tabs);
  element.addEventListener('keydown', (event) => {
    const step = {ArrowLeft: -1, ArrowRight: 1}[event.key];
    // On a wide screen some are not shown: their panels always are.
    const shown = tabs.filter((each) => each.offsetParent);
    const next = step && shown[(shown.indexOf(event.target as HTMLButtonElement) + step + shown.length) % shown.length];
    if (!next) return;
    event.stopPropagation();
    event.preventDefault();
    choose(next.dataset.tab!);
    next.focus();
  });
  return {element, choose};
}

/** Distinct also without red and green (deuteranopia, protanopia). */
const COLORS = ['#2ec7fa', '#fca588', '#7ad025', '#b1435f', '#6e49df', '#43b1b1', '#a53f1d', '#1d61a5'];

/** Colour of an arm's joint in tables and plots. */
export function jointColor(index: number): string {
  return COLORS[index % COLORS.length]!;
}
