// Plots of a log around the time that is shown; a click goes to a time. Commands are dashed.
import uPlot from 'uplot';
import type {Context} from '../context';
import {choice, el, jointColor} from '../dom';
import {angle, shortJoint} from '../units';
import type {Player} from './player';
import type {Joints, Message} from './source';

type Quantity = 'position' | 'velocity' | 'effort' | 'error';
const QUANTITIES: readonly (readonly [Quantity, string])[] = [
  ['position', 'Position'],
  ['velocity', 'Velocity'],
  ['effort', 'Effort'],
  ['error', 'Tracking error'],
];
const POINTS = 900;

interface Samples {
  from: number;
  to: number;
  joints: Message<Joints>[];
  /** The commands of the same ticks. */
  commands: (Joints | null)[];
}

export function logPlots(context: Context, player: Player): HTMLElement {
  let span = 30;
  let samples: Samples | null = null;
  let reading: AbortController | null = null;
  const window_ = (): [number, number] => {
    const {length} = player.source;
    const width = Math.min(span, length);
    const from = Math.min(Math.max(0, player.time - width / 2), length - width);
    return [from, from + width];
  };
  const plots = [new Plot(context, 'position', seek), new Plot(context, 'error', seek)];
  function seek(time: number): void {
    player.play(false);
    player.seek(time);
  }
  const read = async () => {
    reading?.abort();
    reading = new AbortController();
    // Half as much on both sides, so that it is read seldom while the log plays.
    const [from, to] = window_();
    const room = (to - from) / 2;
    const wide = {from: Math.max(0, from - room), to: to + room};
    const topics = player.source.topics('/joint_states', '/joint_commands');
    try {
      const options = {...wide, points: POINTS, signal: reading.signal};
      const messages = await player.source.read<Joints>(topics, options);
      const commands = new Map(messages.filter(({topic}) => topic === '/joint_commands').map(({t, data}) => [t, data]));
      const joints = messages.filter(({topic}) => topic === '/joint_states');
      samples = {...wide, joints, commands: joints.map(({t}) => commands.get(t) ?? null)};
      for (const plot of plots) plot.fill(samples);
      draw();
    } catch {
      /* A later window is being read, or the server is gone: the header says so. */
    }
    reading = null;
  };
  const draw = () => {
    for (const plot of plots) plot.show(window_(), player.time);
  };
  const check = () => {
    const [from, to] = window_();
    const inside = samples && from > samples.from - 1e-6 && to < samples.to + 1e-6;
    // After a wide window a narrow one has too few points.
    const fine = samples && to - from > (samples.to - samples.from) / 5;
    if (!(inside && fine) && !reading) void read();
    draw();
  };
  const spans = choice(
    [
      ['5', '5 s'],
      ['30', '30 s'],
      ['300', '5 min'],
      ['Infinity', 'all'],
    ] as const,
    '30',
    (value) => {
      span = Number(value);
      samples = null;
      check();
    },
  );
  player.onTime.on(check);
  const rebuild = () => {
    for (const plot of plots) plot.build();
    if (samples) for (const plot of plots) plot.fill(samples);
    draw();
  };
  context.onSelect.on(rebuild);
  angle.changed.on(rebuild);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', rebuild);
  return el(
    'section',
    {class: 'plots', attributes: {'data-panel': 'plots'}},
    ...plots.map((plot) => plot.element),
    spans.element,
  );
}

class Plot {
  readonly element = el('div', {class: 'plot'});
  private readonly area = el('div', {class: 'plot-area'});
  private readonly select = el('select', {attributes: {'aria-label': 'quantity'}});
  private readonly legend = el('div', {class: 'legend'});
  private readonly line = el('div', {class: 'now'});
  private chart!: uPlot;
  private samples: Samples | null = null;
  private at = 0;

  constructor(
    private readonly context: Context,
    private quantity: Quantity,
    private readonly seek: (time: number) => void,
  ) {
    for (const [value, text] of QUANTITIES) this.select.append(el('option', {text, attributes: {value}}));
    this.select.value = quantity;
    this.select.addEventListener('change', () => {
      this.quantity = this.select.value as Quantity;
      this.build();
      if (this.samples) this.fill(this.samples);
    });
    this.element.append(el('div', {class: 'plot-head'}, this.select, this.legend), this.area);
    new ResizeObserver(() => {
      const {clientWidth: width, clientHeight: height} = this.area;
      if (width && height) this.chart.setSize({width, height});
      this.mark();
    }).observe(this.area);
    this.build();
  }

  build(): void {
    const scale = this.chart?.scales.x;
    this.chart?.destroy();
    const style = getComputedStyle(document.documentElement);
    const [text, line] = [style.getPropertyValue('--muted').trim(), style.getPropertyValue('--line').trim()];
    const font = '11px system-ui, sans-serif';
    const axis = {stroke: text, grid: {stroke: line, width: 1}, ticks: {stroke: line, width: 1, size: 4}, font};
    const names = (this.context.arm?.joints ?? []).map((joint) => shortJoint(joint, this.context.selected));
    const series = names.map((label, i) => ({label, stroke: jointColor(i), width: 1.25, points: {show: false}}));
    const commands = series.map((each) => ({...each, dash: [4, 4], width: 1}));
    this.chart = new uPlot(
      {
        width: Math.max(50, this.area.clientWidth),
        height: Math.max(50, this.area.clientHeight),
        legend: {show: false},
        cursor: {y: false, points: {show: false}, drag: {x: false, y: false}},
        scales: {x: {time: false, auto: false}, y: {range: (_plot, low, high) => padded(low, high, this.least)}},
        axes: [
          {...axis, size: 24, values: (_plot, values) => values.map((value) => `${Number(value.toFixed(3))} s`)},
          {...axis, size: 52},
        ],
        series: [{}, ...series, ...(this.quantity === 'position' ? commands : [])],
      },
      [[]],
      this.area,
    );
    this.chart.over.append(this.line);
    this.chart.over.addEventListener('click', (event) => {
      const left = event.clientX - this.chart.over.getBoundingClientRect().left;
      this.seek(this.chart.posToVal(left, 'x'));
    });
    this.legend.replaceChildren(
      el('span', {class: 'unit', text: this.unit}),
      ...names.map((name, i) => {
        const item = el('span', {text: name});
        item.style.setProperty('--color', jointColor(i));
        return item;
      }),
    );
    if (scale?.min != null && scale.max != null) this.chart.setScale('x', {min: scale.min, max: scale.max});
  }

  fill(samples: Samples): void {
    this.samples = samples;
    const {joints, commands} = samples;
    const factor = this.quantity === 'effort' ? 1 : angle.factor;
    const rows = (this.context.arm?.joints ?? []).map((joint) => {
      const places = new Map<string, number>();
      const place = ({name}: Joints) => {
        const key = name.join('\n');
        if (!places.has(key)) places.set(key, name.indexOf(joint));
        return places.get(key)!;
      };
      const scaled = (value: number | null | undefined) => (typeof value === 'number' ? value * factor : null);
      const command = commands.map((each) => (each ? scaled(each.position[each.name.indexOf(joint)]) : null));
      if (this.quantity === 'error') {
        const error = joints.map(({data}, i) => {
          const own = scaled(data.position[place(data)]);
          return own === null || command[i] == null ? null : command[i]! - own;
        });
        return {own: error, command: null};
      }
      const {quantity} = this;
      return {own: joints.map(({data}) => scaled(data[quantity][place(data)])), command};
    });
    const commanded = this.quantity === 'position' ? rows.map(({command}) => command!) : [];
    const data = [joints.map(({t}) => t), ...rows.map(({own}) => own), ...commanded];
    this.chart.setData(data as uPlot.AlignedData, false);
    const {min, max} = this.chart.scales.x!;
    // Draws, with the range of the new values.
    if (min != null && max != null) this.chart.setScale('x', {min, max});
  }

  show([from, to]: [number, number], time: number): void {
    this.at = time;
    const {min, max} = this.chart.scales.x!;
    if (min !== from || max !== to) this.chart.setScale('x', {min: from, max: to});
    this.mark();
  }

  private mark(): void {
    const left = this.chart.valToPos(this.at, 'x');
    if (Number.isFinite(left)) this.line.style.transform = `translateX(${left.toFixed(1)}px)`;
  }

  private get unit(): string {
    return {position: angle.label, velocity: `${angle.label}/s`, effort: 'Nm', error: angle.label}[this.quantity];
  }

  /** Half of the smallest range that is shown: noise of an arm at rest does not fill the plot. */
  private get least(): number {
    if (this.quantity === 'effort') return 0.5;
    return (this.quantity === 'error' ? 0.002 : 0.05) * angle.factor;
  }
}

function padded(low: number | null, high: number | null, least: number): [number, number] {
  if (low === null || high === null || !Number.isFinite(low) || !Number.isFinite(high)) return [-least, least];
  const room = Math.max((high - low) * 0.08, least - (high - low) / 2, 0);
  return [low - room, high + room];
}
