// Data of the plots: the last minutes of each joint, of the tracking error, and of the tick, in buffers that never grow.
import type {JointState, State} from './protocol';

export const LONGEST = 180; // s that are kept
const GAP = 0.7; // s without a sample

/** Columns of one sample each, in a ring: the time first. */
export class Ring {
  private readonly columns: Float64Array[];
  private readonly size: number;
  private count = 0;

  constructor(size: number, columns: number) {
    this.size = size;
    this.columns = Array.from({length: columns + 1}, () => new Float64Array(size));
  }

  push(time: number, values: (number | null | undefined)[]): void {
    // A clock that was set back would draw lines to the left.
    if (time <= this.last) return;
    // Lines end where data was missing.
    if (time - this.last > GAP) this.store(this.last + GAP, []);
    this.store(time, values);
  }

  private store(time: number, values: (number | null | undefined)[]): void {
    const index = this.count % this.size;
    this.columns[0]![index] = time;
    for (let i = 1; i < this.columns.length; i++) this.columns[i]![index] = values[i - 1] ?? NaN;
    this.count += 1;
  }

  get length(): number {
    return Math.min(this.count, this.size);
  }

  get last(): number {
    return this.length ? this.at(0, this.length - 1) : NaN;
  }

  /** The samples since a time, at most `most` of each column; with `peaks` the largest of those left out stays. */
  since(time: number, most: number, peaks: boolean): (number | null)[][] {
    let first = this.length;
    while (first > 0 && this.at(0, first - 1) >= time) first -= 1;
    const stride = Math.max(1, Math.ceil((this.length - first) / most));
    // A window begins at a multiple of the stride, so that the same samples are chosen each time.
    const begin = Math.max(0, this.count - this.length + first);
    first += (stride - (begin % stride)) % stride;
    const out: (number | null)[][] = this.columns.map(() => []);
    for (let i = first; i < this.length; i += stride) {
      out[0]!.push(this.at(0, i));
      for (let c = 1; c < this.columns.length; c++) {
        let value = this.at(c, i);
        for (let j = 1; j < stride && i + j < this.length; j++) {
          const other = this.at(c, i + j);
          if (Number.isNaN(other) || (peaks && Math.abs(other) > Math.abs(value))) value = other;
        }
        out[c]!.push(Number.isNaN(value) ? null : value);
      }
    }
    return out;
  }

  private at(column: number, index: number): number {
    const oldest = this.count > this.size ? this.count % this.size : 0;
    return this.columns[column]![(oldest + index) % this.size]!;
  }
}

export type Quantity = 'position' | 'velocity' | 'effort' | 'error' | 'lateness';

interface ArmHistory {
  joints: string[];
  position: Ring;
  velocity: Ring;
  effort: Ring;
  error: Ring;
}

export class History {
  readonly arms = new Map<string, ArmHistory>();
  readonly lateness = new Ring(LONGEST * 30, 1);
  private indices: number[][] = [];
  private names = '';
  /** Lateness is the distance of a tick's time from the earliest of the last seconds, per period. */
  private offsets: number[] = [];

  constructor(
    arms: {name: string; joints: string[]}[],
    private readonly period: () => number | null,
  ) {
    for (const {name, joints} of arms) {
      const ring = (rate: number) => new Ring(LONGEST * rate, joints.length);
      this.arms.set(name, {joints, position: ring(30), velocity: ring(30), effort: ring(30), error: ring(10)});
    }
  }

  takeJoints(state: JointState): void {
    this.takePast(state);
    this.takeTick(state);
  }

  /** A state whose time is not exactly that of its tick: it says nothing of lateness. */
  takePast(state: JointState): void {
    const names = state.name.join();
    if (names !== this.names) {
      this.names = names;
      this.indices = [...this.arms.values()].map(({joints}) => joints.map((joint) => state.name.indexOf(joint)));
    }
    let a = 0;
    for (const arm of this.arms.values()) {
      const indices = this.indices[a++]!;
      arm.position.push(
        state.stamp,
        indices.map((i) => state.position[i]),
      );
      arm.velocity.push(
        state.stamp,
        indices.map((i) => state.velocity[i]),
      );
      arm.effort.push(
        state.stamp,
        indices.map((i) => state.effort[i]),
      );
    }
  }

  /** `follows`: whether an arm is commanded by positions, so that there is a tracking error. */
  takeState(state: State, follows: (arm: string) => boolean): void {
    for (const {hardware_id, joints} of state.arms) {
      this.arms.get(hardware_id)?.error.push(
        state.stamp,
        joints.map(({command, position}) =>
          follows(hardware_id) && typeof command === 'number' && position !== null ? command - position : null,
        ),
      );
    }
  }

  private takeTick(state: JointState): void {
    const period = this.period();
    if (!period) return;
    const offset = state.stamp - state.tick * period;
    // Ten seconds: shorter than it takes for the wall clock's drift to show.
    this.offsets.push(offset);
    if (this.offsets.length > 300) this.offsets.shift();
    const lateness = offset - Math.min(...this.offsets);
    this.lateness.push(state.stamp, [lateness * 1e6]);
  }
}
