// Plots of the last minutes: joints of the selected arm, or the lateness of ticks.
import uPlot from 'uplot';
import type {Context} from '../context';
import {choice, el, jointColor} from '../dom';
import type {Quantity} from '../history';
import {angle, shortJoint} from '../units';

const REDRAW = 200; // ms
const MOST_POINTS = 600;
const QUANTITIES: readonly (readonly [Quantity, string])[] = [
  ['position', 'Position'],
  ['velocity', 'Velocity'],
  ['effort', 'Effort'],
  ['error', 'Tracking error'],
  ['lateness', 'Tick lateness'],
];

export function plotsPanel(context: Context): HTMLElement {
  let span = 60;
  const spans = choice(
    [
      ['30', '30 s'],
      ['60', '1 min'],
      ['180', '3 min'],
    ] as const,
    '60',
    (value) => {
      span = Number(value);
    },
  );
  const plots = [new Plot(context, 'position', () => span), new Plot(context, 'error', () => span)];
  const element = el(
    'section',
    {class: 'plots', attributes: {'data-panel': 'plots'}},
    ...plots.map((plot) => plot.element),
    spans.element,
  );
  window.setInterval(() => {
    if (!document.hidden) for (const plot of plots) plot.draw();
  }, REDRAW);
  const rebuild = () => {
    for (const plot of plots) plot.build();
  };
  context.onSelect.on(rebuild);
  angle.changed.on(rebuild);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', rebuild);
  return element;
}

class Plot {
  readonly element = el('div', {class: 'plot'});
  private readonly area = el('div', {class: 'plot-area'});
  private readonly select = el('select', {attributes: {'aria-label': 'quantity'}});
  private readonly legend = el('div', {class: 'legend'});
  private chart: uPlot | null = null;

  constructor(
    private readonly context: Context,
    private quantity: Quantity,
    private readonly span: () => number,
  ) {
    for (const [value, text] of QUANTITIES) this.select.append(el('option', {text, attributes: {value}}));
    this.select.value = quantity;
    this.select.addEventListener('change', () => {
      this.quantity = this.select.value as Quantity;
      this.build();
    });
    this.element.append(el('div', {class: 'plot-head'}, this.select, this.legend), this.area);
    new ResizeObserver(() => this.resize()).observe(this.area);
    this.build();
  }

  build(): void {
    this.chart?.destroy();
    const style = getComputedStyle(document.documentElement);
    const [text, line] = [style.getPropertyValue('--muted').trim(), style.getPropertyValue('--line').trim()];
    const names =
      this.quantity === 'lateness'
        ? ['sampled ticks']
        : (this.context.arm?.joints ?? []).map((joint) => shortJoint(joint, this.context.selected));
    const font = '11px system-ui, sans-serif';
    const axis = {stroke: text, grid: {stroke: line, width: 1}, ticks: {stroke: line, width: 1, size: 4}, font};
    this.chart = new uPlot(
      {
        width: Math.max(50, this.area.clientWidth),
        height: Math.max(50, this.area.clientHeight),
        legend: {show: false},
        cursor: {y: false, points: {show: false}},
        scales: {x: {time: false}, y: {range: (_plot, low, high) => padded(low, high, this.quantity)}},
        axes: [
          {...axis, size: 24, values: (_plot, values) => values.map((value) => `${value.toFixed(0)} s`)},
          {...axis, size: 52},
        ],
        series: [
          {},
          ...names.map((name, i) => ({label: name, stroke: jointColor(i), width: 1.25, points: {show: false}})),
        ],
      },
      [[]],
      this.area,
    );
    this.legend.replaceChildren(
      el('span', {class: 'unit', text: this.unit()}),
      ...names.map((name, i) => {
        const item = el('span', {text: name});
        item.style.setProperty('--color', jointColor(i));
        return item;
      }),
    );
    this.draw();
  }

  draw(): void {
    const {history, selected, run} = this.context;
    if (!this.chart || !this.area.clientWidth) return;
    const ring = this.quantity === 'lateness' ? history.lateness : history.arms.get(selected)?.[this.quantity];
    if (!ring?.length) return;
    // Without data the time axis continues, so that the gap is seen.
    const now = history.lateness.length ? history.lateness.last + (run.stale ? run.age / 1000 : 0) : ring.last;
    const peaks = this.quantity === 'lateness' || this.quantity === 'error';
    const data = ring.since(now - this.span(), MOST_POINTS, peaks);
    const turned = ['position', 'velocity', 'error'].includes(this.quantity) ? angle.factor : 1;
    const [time, ...values] = data;
    const shown = [
      time!.map((t) => t! - now),
      ...values.map((row) => (turned === 1 ? row : row.map((v) => (v === null ? null : v * turned)))),
    ];
    this.chart.setData(shown as uPlot.AlignedData, false);
    this.chart.setScale('x', {min: -this.span(), max: 0});
  }

  private unit(): string {
    const rate = angle.unit === 'deg' ? '°' : 'rad';
    return {position: rate, velocity: `${rate}/s`, effort: 'Nm', error: rate, lateness: 'µs'}[this.quantity];
  }

  private resize(): void {
    const {clientWidth: width, clientHeight: height} = this.area;
    if (width && height) this.chart?.setSize({width, height});
  }
}

/** Room above and below the lines; noise of an arm at rest does not fill the plot. */
function padded(low: number | null, high: number | null, quantity: Quantity): [number, number] {
  if (quantity === 'lateness') return [0, Math.max((high ?? 0) * 1.1, 100)];
  const smallest =
    (quantity === 'effort' ? 0.5 : quantity === 'error' ? 0.002 : 0.05) * (quantity === 'effort' ? 1 : angle.factor);
  if (low === null || high === null || !Number.isFinite(low) || !Number.isFinite(high)) return [-smallest, smallest];
  const room = Math.max((high - low) * 0.08, smallest - (high - low) / 2, 0);
  return [low - room, high + room];
}
