// Jogging, the requests of `dimos jog`: targets are sent while something is held, and nothing else moves the arm.
// Dead-man by design: if the page, the browser or the connection fails, the stream ends and the task's timeout
// decelerates the joints to rest.
import type {Context} from './context';
import {pause} from './flow';
import {RpcError, type Task} from './protocol';
import {Signal} from './signal';

/** Time between two targets [ms]. */
const PERIOD = 20;
/** Without a reply to a target for this long the jog ends [ms]. At most one target is on its way. */
const LATE = 500;
/** Time at rest after which the task ends and the lease is released, for others [ms]. */
const RELEASE_AFTER = 500;
/** Without joint states for this long nothing is jogged [ms]. */
const BLIND_AFTER = 1000;
/** Selectable speeds, as fractions of the top speeds. */
export const SPEEDS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1];
/** Top speeds [m/s], [rad/s], [rad/s]: those of `dimos jog`. */
export const TOP = {linear: 0.25, angular: 1, joint: 0.5};
/** Largest lead of a servo target over its joint [rad], and distance of targets from a joint's limits [rad]. */
const MAX_LEAD = 0.15;
const MARGIN = 0.01;

export type JogMode = 'joints' | 'tool';
/** A joint by its number, or an axis of the end effector: along x, y, z, about x, y, z. */
export interface Motion {
  kind: 'joint' | 'axis';
  index: number;
  sign: 1 | -1;
}

interface Drive {
  kind: 'twist' | 'velocity' | 'servo';
  task: string;
  joints: string[];
}

export class Jog {
  mode: JogMode = 'tool';
  frame: 'base' | 'tool' = 'base';
  speed = 4;
  /** Whether targets are sent, or were until just now. */
  active = false;
  /** Why the run refused, or why the jog ended. */
  problem: {text: string; hint?: string} | null = null;
  readonly changed = new Signal();
  /** What holds a motion: a pointer or a key. */
  private readonly held = new Map<string, Motion>();
  private targets: number[] = [];
  private sent = 0;

  constructor(private readonly context: Context) {
    const {run, stop} = context;
    const end = () => this.releaseAll();
    // Without the focus there are no key-ups and perhaps no pointer-ups.
    window.addEventListener('blur', end);
    window.addEventListener('pagehide', end);
    document.addEventListener('visibilitychange', () => document.hidden && end());
    context.onSelect.on(end);
    stop.changed.on(end);
    run.onLink.on(() => run.connected || end());
    run.onStatus.on(() => this.changed.emit());
  }

  /** The task of a mode: that of the highest priority that moves joints of this arm only, as `dimos jog` chooses. */
  drive(mode: JogMode): Drive | null {
    const own = this.context.arm?.joints ?? [];
    const find = (kind: Drive['kind']): Drive | null => {
      const tasks = (this.context.run.status?.tasks ?? []).filter(
        ({takes, joints}) => takes?.includes(kind) && joints.length && joints.every((joint) => own.includes(joint)),
      );
      const task = tasks.sort((a, b) => (b.priority ?? 0) - (a.priority ?? 0))[0];
      return task ? {kind, task: task.name, joints: task.joints} : null;
    };
    return mode === 'tool' ? find('twist') : (find('velocity') ?? find('servo'));
  }

  /** The task that jog uses now, as the run reports it. */
  get task(): Task | undefined {
    const name = this.drive(this.mode)?.task;
    return this.context.run.status?.tasks.find((task) => task.name === name);
  }

  isHeld(motion: Motion): boolean {
    return [...this.held.values()].some((each) => same(each, motion));
  }

  hold(source: string, motion: Motion): void {
    if (!this.drive(this.mode)) return;
    // The opposite key or button replaces the first.
    for (const [key, each] of this.held)
      if (each.kind === motion.kind && each.index === motion.index) this.held.delete(key);
    this.held.set(source, motion);
    this.problem = null;
    if (!this.active) void this.run();
    this.changed.emit();
  }

  release(source: string): void {
    if (this.held.delete(source)) this.changed.emit();
  }

  releaseAll(): void {
    if (!this.held.size) return;
    this.held.clear();
    this.changed.emit();
  }

  set(values: Partial<Pick<Jog, 'mode' | 'frame' | 'speed'>>): void {
    if (values.speed === undefined) this.releaseAll();
    Object.assign(this, values);
    this.speed = Math.max(0, Math.min(SPEEDS.length - 1, this.speed));
    this.changed.emit();
  }

  get fraction(): number {
    return SPEEDS[this.speed]!;
  }

  /** Sends targets while something is held; then rests, ends the task and releases the lease. */
  private async run(): Promise<void> {
    const {run, selected: arm} = this.context;
    const drive = this.drive(this.mode)!;
    const mode = this.mode;
    this.active = run.streaming = true;
    this.targets = [];
    this.sent = performance.now();
    try {
      for (let rest = 0; ; ) {
        const began = performance.now();
        if (this.held.size && run.age > BLIND_AFTER) throw new RpcError('STALE', 'no joint states: the jog ended');
        if (this.held.size && this.mode === mode && this.context.selected === arm) {
          rest = 0;
          await this.send(drive);
        } else if (!rest) {
          rest = began;
          await this.sendRest(drive);
        } else if (began - rest > RELEASE_AFTER || this.mode !== mode || this.context.selected !== arm) {
          break;
        }
        await pause(Math.max(0, PERIOD - (performance.now() - began)));
      }
      await run.work.request('cancel', {task: drive.task}, LATE);
    } catch (error) {
      const known = error instanceof RpcError ? error : new RpcError('INTERNAL', String(error));
      const lost = known.code === 'LOST' && 'the arm decelerates to rest: hold again when the run replies';
      const hint = lost || known.hint;
      this.problem = {text: known.message, hint};
      this.held.clear();
    }
    // The lease may be the reason of the refusal: release it.
    await run.work.request('release', {arm}, LATE).catch(() => {});
    this.active = run.streaming = false;
    if (this.held.size) void this.run();
    this.changed.emit();
  }

  private async send({kind, task, joints}: Drive): Promise<void> {
    const {run} = this.context;
    const share = this.fraction;
    const axes = [0, 0, 0, 0, 0, 0];
    const single = joints.map(() => 0);
    for (const {kind: of, index, sign} of this.held.values()) {
      if (of === 'axis') axes[index]! += sign * share * (index < 3 ? TOP.linear : TOP.angular);
      else if (index < single.length) single[index]! += sign * share * TOP.joint;
    }
    const now = performance.now();
    if (kind === 'twist') {
      const params = {task, linear: axes.slice(0, 3), angular: axes.slice(3), frame: this.frame};
      await run.work.request('twist', params, LATE);
    } else if (kind === 'velocity') {
      await run.work.request('velocity', {task, velocities: single}, LATE);
    } else {
      const positions = this.advance(joints, single, (now - this.sent) / 1000);
      if (positions) await run.work.request('servo', {task, positions}, LATE);
    }
    this.sent = now;
  }

  /** Zero, for a task that follows velocities; a servo task rests at its last target. */
  private async sendRest({kind, task, joints}: Drive): Promise<void> {
    const {work} = this.context.run;
    if (kind === 'twist') await work.request('twist', {task, linear: [0, 0, 0], angular: [0, 0, 0]}, LATE);
    else if (kind === 'velocity') await work.request('velocity', {task, velocities: joints.map(() => 0)}, LATE);
  }

  /** Next servo targets: the commanded positions, integrated; near the arm, and inside its limits. */
  private advance(joints: string[], speeds: number[], seconds: number): number[] | null {
    const {run, selected} = this.context;
    const [state, arm] = [run.armState(selected), run.arm(selected)];
    const seen = joints.map((name) => state?.joints.find((joint) => joint.name === name));
    if (!this.targets.length) {
      // In another mode a command is not a position.
      const commands = arm?.mode.endsWith('position');
      const from = seen.map((joint) => (commands ? joint?.command : null) ?? joint?.position ?? null);
      if (from.some((position) => position === null)) return null;
      this.targets = from as number[];
    }
    speeds.forEach((speed, i) => {
      const measured = this.context.position(joints[i]!);
      if (!speed || measured === null) return;
      const place = state?.joints.findIndex((joint) => joint.name === joints[i]) ?? -1;
      const [lower, upper] = arm?.position_limits[place] ?? [-Infinity, Infinity];
      const target = this.targets[i]!;
      const next = Math.max(measured - MAX_LEAD, Math.min(measured + MAX_LEAD, target + speed * seconds));
      // A joint that begins outside its limits may move back in.
      this.targets[i] = Math.min(Math.max(upper - MARGIN, target), Math.max(Math.min(lower + MARGIN, target), next));
    });
    return [...this.targets];
  }
}

function same(a: Motion, b: Motion): boolean {
  return a.kind === b.kind && a.index === b.index && a.sign === b.sign;
}
