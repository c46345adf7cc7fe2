// One motion from goal to end: plan, preview, execute, cancel. Nothing moves before `execute` or `moveDirect`.
import {
  type GoingReport,
  type MotionReport,
  type PlanningReport,
  type Preview,
  type Quat,
  RpcError,
  type Vec3,
} from './protocol';
import type {Run} from './run';
import {Signal} from './signal';

const POLL = 100; // ms
const PREVIEW_RATE = 30; // Hz
const PREVIEW_POINTS = 6000;

export type Goal =
  | {robot: string; joints: number[]}
  | {robot: string; named: string}
  | {robot: string; pose: {xyz: Vec3; quat?: Quat}; linear?: boolean};

/** Parameters of `plan`. */
export interface PlanRequest {
  goals: Goal[];
  speed: number;
  through?: Goal[];
  blend?: number;
}

export type Stage = 'idle' | 'planning' | 'planned' | 'failed' | 'executing' | 'ended';

export class Flow {
  stage: Stage = 'idle';
  /** The arms that move. */
  arms: string[] = [];
  plan: number | null = null;
  /** The number of the motion in the run. */
  private going: number | null = null;
  preview: Preview | null = null;
  planning: PlanningReport | null = null;
  motion: MotionReport | null = null;
  /** What happened last, for people. */
  text = '';
  error: RpcError | null = null;
  readonly changed = new Signal();
  /** People want to see the plan. */
  readonly onPlay = new Signal();

  constructor(private readonly run: Run) {}

  get busy(): boolean {
    return this.stage === 'planning' || this.stage === 'executing';
  }

  async makePlan(arms: string[], request: PlanRequest): Promise<void> {
    if (this.busy) return;
    this.forget();
    this.arms = arms;
    this.set('planning', 'planning…');
    try {
      const {plan} = await this.run.work.request<{plan: number}>('plan', request);
      this.plan = plan;
      this.changed.emit();
      const report = await this.untilPlanned(plan);
      this.planning = report;
      if (report.state !== 'PLANNED') {
        const why = report.state === 'CANCELLED' ? 'planning cancelled' : (report.error ?? 'no plan found');
        throw new RpcError('NO_PLAN', why, report.hint ?? undefined);
      }
      const hz = Math.max(0.1, Math.min(PREVIEW_RATE, PREVIEW_POINTS / Math.max(report.summary?.duration ?? 1, 0.1)));
      this.preview = await this.run.work.request<Preview>('preview', {plan, hz});
      this.set('planned', `planned in ${(report.elapsed * 1000).toFixed(0)} ms`);
    } catch (error) {
      this.fail(error);
    }
  }

  /** Moves the arms along the plan. */
  async execute(): Promise<void> {
    if (this.stage !== 'planned' || this.plan === null) return;
    await this.go({execute_plan: {plan: this.plan}});
  }

  /** Moves the arm in joint space without a plan: not collision-checked. */
  async moveDirect(arm: string, target: number[], speed: number): Promise<void> {
    if (this.busy) return;
    this.forget();
    this.arms = [arm];
    await this.go({move: {arm, target, speed, direct: true}});
  }

  private async go(step: object): Promise<void> {
    this.set('executing', 'starting…');
    try {
      const {going} = await this.run.work.request<{going: number}>('go', {steps: [step]});
      this.going = going;
      await this.follow(going);
    } catch (error) {
      this.fail(error);
    }
  }

  /** Ends planning, or decelerates the motion to rest. */
  async cancel(arm: string): Promise<void> {
    // It may move several arms.
    const own = this.stage === 'executing' && this.going !== null ? {going: this.going} : {arm};
    const params = this.stage === 'planning' && this.plan !== null ? {plan: this.plan} : own;
    const {tasks} = await this.run.watch.request<{tasks: Record<string, string>}>('cancel', params);
    if (!this.busy)
      this.text = Object.values(tasks ?? {}).includes('CANCELLED') ? 'motion cancelled' : 'nothing to cancel';
    this.changed.emit();
  }

  /** Drops the plan; it stays known to the run. */
  clear(): void {
    if (this.busy || this.stage === 'idle') return;
    this.forget();
    this.set('idle', '');
  }

  private async untilPlanned(plan: number): Promise<PlanningReport> {
    for (;;) {
      const report = await this.run.work.request<PlanningReport>('planning', {plan});
      if (report.state !== 'PLANNING') return report;
      await pause(POLL);
    }
  }

  /** Shows a motion to its end. It continues without the page: a lost connection ends only the watching. */
  private async follow(going: number): Promise<void> {
    let report: GoingReport | null = null;
    for (;;) {
      try {
        report = await this.run.work.request<GoingReport>('going', {going});
        this.motion = report.steps.at(-1)?.motions?.at(-1) ?? null;
        if (report.done) break;
        if (this.motion) this.text = 'moving';
      } catch (error) {
        if (!(error instanceof RpcError) || error.code !== 'LOST') throw error;
        if (this.run.work.state === 'refused') throw error;
        this.text = 'connection lost: the motion continues';
      }
      this.changed.emit();
      await pause(POLL);
    }
    // The arms are free for other programs as soon as they are at rest.
    for (const arm of this.arms) await this.run.work.request('release', {arm}).catch(() => {});
    if (report.error) throw new RpcError(report.error.code, report.error.message, report.error.hint);
    if (!this.motion) throw new RpcError('INTERNAL', 'the run reports no motion');
    const {state, error, deviation, elapsed} = this.motion;
    if (state !== 'COMPLETED') throw new RpcError(state, error ?? `motion ${state.toLowerCase()}`);
    const worst = Math.max(0, ...(deviation ?? []).map(({target, actual}) => Math.abs(target - actual)));
    this.set('ended', `completed in ${elapsed.toFixed(1)} s, final error ${worst.toFixed(4)} rad`);
  }

  private forget(): void {
    this.plan = this.preview = this.planning = this.motion = this.error = this.going = null;
  }

  private set(stage: Stage, text: string): void {
    this.stage = stage;
    this.text = text;
    this.changed.emit();
  }

  private fail(error: unknown): void {
    this.error = error instanceof RpcError ? error : new RpcError('INTERNAL', String(error));
    this.preview = null;
    this.set('failed', this.error.message);
  }
}

export function pause(milliseconds: number): Promise<void> {
  return new Promise((resolve) => window.setTimeout(resolve, milliseconds));
}
