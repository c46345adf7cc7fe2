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

const COLORS = ['#4c9aff', '#f5a524', '#30a46c', '#e5484d', '#ab6bff', '#12a5b5', '#d6409f', '#8b8d98'];

/** Colour of an arm's joint in tables and plots. */
export function jointColor(index: number): string {
  return COLORS[index % COLORS.length]!;
}
