// The run as the page knows it: newest joint states, state, status, world and events, and the age of the data.
import {Connection} from './connection';
import type {JointState, PlannerReport, PosesReport, RunEvent, Scene, State, Status, WorldObject} from './protocol';
import {Signal} from './signal';

const JOINT_RATE = 30; // Hz
const STATE_PERIOD = 100; // ms: commands, poses, grippers
const STATUS_PERIOD = 500;
const WORLD_PERIOD = 1000;
/** Joint states older than this are shown as stale [ms]. */
export const STALE_AFTER = 500;
const SILENT_AFTER = 3000; // ms without a reply to `status` before the connection counts as lost
const EVENTS_KEPT = 200;
/** Slower joints are at rest [rad/s]. */
const STANDSTILL = 0.01;

export class Run {
  status: Status | null = null;
  state: State | null = null;
  joints: JointState | null = null;
  planner: PlannerReport | null = null;
  poses: PosesReport['poses'] = {};
  world: WorldObject[] = [];
  readonly events: RunEvent[] = [];
  /** Targets are sent on `work`: nothing that may take long goes there. */
  streaming = false;
  /** Messages that this page was too slow for. */
  lost = 0;

  readonly onJoints = new Signal<JointState>();
  /** Joint states from before the page was opened or connected again. */
  readonly onPastJoints = new Signal<JointState>();
  readonly onState = new Signal<State>();
  readonly onStatus = new Signal<Status>();
  readonly onWorld = new Signal();
  readonly onPoses = new Signal();
  readonly onEvent = new Signal<RunEvent>();
  readonly onLink = new Signal();

  /** Subscriptions and acts; its requests complete one after the other. */
  readonly work: Connection;
  /** `status`, `stop` and `cancel` only: the run answers these at once, whatever `work` waits for. */
  readonly watch: Connection;

  private received = 0;
  private stateReceived = 0;

  constructor(
    readonly scene: Scene,
    url: string,
    token: string,
  ) {
    this.work = new Connection(url, token);
    this.watch = new Connection(url, token);
  }

  start(): void {
    this.work.onStream = (...message) => this.takeStream(...message);
    this.work.onState = () => {
      if (this.work.state === 'open') void this.begin();
      this.onLink.emit();
    };
    this.watch.onState = () => this.onLink.emit();
    this.work.open();
    this.watch.open();
    this.repeat(STATUS_PERIOD, () => this.readStatus());
    this.repeat(STATE_PERIOD, () => this.readState());
    this.repeat(WORLD_PERIOD, () => this.readWorld());
  }

  get connected(): boolean {
    return this.work.state === 'open' && this.watch.state === 'open';
  }

  /** Age of the newest joint state [ms]; infinite before the first. */
  get age(): number {
    return this.received ? performance.now() - this.received : Infinity;
  }

  get stale(): boolean {
    return this.age > STALE_AFTER;
  }

  /** Whether no arm moves or is about to, as far as is known. */
  get atRest(): boolean {
    const moves = this.status?.tasks.some(({state}) => state === 'EXECUTING' || state === 'CANCELLING');
    const still = this.joints?.velocity.every((velocity) => Math.abs(velocity ?? 0) < STANDSTILL);
    return this.connected && !this.stale && !this.streaming && !!still && !moves;
  }

  /** Age of an arm's newest state [ms]; infinite before the first. */
  armAge(name: string): number {
    const age = this.armState(name)?.age_ms ?? Infinity;
    // A reply that is late because `work` waits for another one does not make the arm's state old.
    return age + Math.min(this.age, performance.now() - this.stateReceived);
  }

  armStale(name: string): boolean {
    return this.armAge(name) > STALE_AFTER;
  }

  arm(name: string) {
    return this.status?.arms.find((arm) => arm.hardware_id === name);
  }

  armState(name: string) {
    return this.state?.arms.find((arm) => arm.hardware_id === name);
  }

  /** Reads what changes seldom: after connecting, and after acts that change it. */
  async readPoses(): Promise<void> {
    this.poses = (await this.work.request<PosesReport>('poses')).poses;
    this.onPoses.emit();
  }

  async readWorld(): Promise<void> {
    // The planner handles one request at a time: while it plans, this connection would wait for it.
    if (this.streaming || !this.status?.planner || this.status.planner.state === 'PLANNING') return;
    this.world = (await this.work.request<{objects: WorldObject[]}>('world')).objects;
    this.onWorld.emit();
  }

  private async begin(): Promise<void> {
    try {
      await this.work.request('subscribe', {stream: 'coordinator_joint_state', rate: JOINT_RATE, past: true});
      await this.work.request('subscribe', {stream: 'events', past: true});
      if (this.scene.planner) this.planner = await this.work.request<PlannerReport>('planner');
      await this.readPoses();
    } catch (error) {
      console.warn(error);
    }
  }

  private takeStream(stream: string, data: unknown, lost: number, past: boolean): void {
    if (stream === 'coordinator_joint_state' && past) {
      this.onPastJoints.emit(data as JointState);
    } else if (stream === 'coordinator_joint_state') {
      this.received = performance.now();
      this.lost += lost;
      this.joints = data as JointState;
      this.onJoints.emit(this.joints);
    } else if (stream === 'events') {
      const event = data as RunEvent;
      // After a lost connection the run repeats what is known.
      if (past && event.stamp <= (this.events.at(-1)?.stamp ?? 0)) return;
      this.events.push(event);
      if (this.events.length > EVENTS_KEPT) this.events.shift();
      this.onEvent.emit(event);
    }
  }

  private async readState(): Promise<void> {
    this.state = await this.work.request<State>('state');
    this.stateReceived = performance.now();
    this.onState.emit(this.state);
  }

  private async readStatus(): Promise<void> {
    if (this.watch.state !== 'open') return;
    try {
      this.status = await this.watch.request<Status>('status', {}, SILENT_AFTER);
      this.onStatus.emit(this.status);
    } catch {
      this.watch.drop();
      this.work.drop();
    }
  }

  /** Repeats a request, each this long after the end of the one before. */
  private repeat(period: number, request: () => Promise<void>): void {
    const next = async () => {
      if (this.work.state === 'open' && !document.hidden) await request().catch(() => {});
      window.setTimeout(next, period);
    };
    void next();
  }
}
