// Inverse kinematics of the pose that is dragged: one request at a time, the newest pose next. Moves nothing.
import {pause} from './flow';
import {type IkReply, type Quat, RpcError, type Vec3} from './protocol';
import type {Run} from './run';
import {Signal} from './signal';

/** Shortest time between two requests [ms]. */
const PERIOD = 40;

export interface ReachQuery {
  robot: string;
  pose: {xyz: Vec3; quat?: Quat};
}

export class Reach {
  /** The ghost: joints of the newest pose that could be reached [rad]. */
  joints: number[] | null = null;
  /** Why the newest pose cannot be reached, or what touches there. */
  problem: string | null = null;
  /** Whether the newest pose can be reached, but something touches there. */
  touches = false;
  readonly changed = new Signal();
  private next: {query: ReachQuery; present: number[]; take: (reply: IkReply) => void} | null = null;
  private asking = false;
  /** Changes with `clear`: replies from before count no longer. */
  private epoch = 0;

  constructor(private readonly run: Run) {}

  ask(query: ReachQuery, present: number[], take: (reply: IkReply) => void): void {
    this.next = {query, present, take};
    if (!this.asking) void this.work();
  }

  clear(): void {
    this.epoch += 1;
    this.next = this.joints = this.problem = null;
  }

  private async work(): Promise<void> {
    this.asking = true;
    while (this.next) {
      const {query, present, take} = this.next;
      const epoch = this.epoch;
      this.next = null;
      const began = performance.now();
      try {
        const near = this.joints ?? present;
        const reply = await this.run.work.request<IkReply>('ik', {...query, near});
        if (epoch === this.epoch) {
          // Out of reach, the ghost stays where it was last.
          this.joints = reply.joints ?? this.joints;
          this.problem = reply.error ?? null;
          this.touches = !!reply.joints && this.problem !== null;
          if (!this.next) take(reply);
        }
      } catch (error) {
        // An attached planner of an earlier version does not know the method.
        if (epoch === this.epoch && !(error instanceof RpcError && error.code === 'UNKNOWN_METHOD'))
          this.problem = error instanceof RpcError ? error.message : String(error);
      }
      this.changed.emit();
      await pause(Math.max(0, PERIOD - (performance.now() - began)));
    }
    this.asking = false;
  }
}
