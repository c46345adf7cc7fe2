// Messages of the run and of its view server, as far as the page uses them (docs/rpc.md). Units are SI; unknown is null.

export type Vec3 = [number, number, number];
export type Quat = [number, number, number, number];

/** What does not change during a run: `/scene.json`. */
export interface Scene {
  version: number;
  kind: string;
  name: string;
  simulated: boolean;
  address?: string;
  planner: boolean;
  robots: SceneRobot[];
  arms: SceneArm[];
}

export interface SceneRobot {
  name: string;
  base: {xyz: Vec3; quat: Quat};
  urdf: string;
  tip: string;
  root: string;
  /** The coordinator's joint → the joint of the URDF. */
  joints: Record<string, string>;
  /** The same of joints that other arms move. */
  moved_by_others?: Record<string, string>;
  /** Positions of joints of the URDF that stay where they are [rad or m]. */
  fixed?: Record<string, number>;
  /** Named poses, in the order of `joints`. */
  groups?: Record<string, number[]>;
  limits: Record<string, JointLimit>;
}

export interface JointLimit {
  lower: number | null;
  upper: number | null;
  velocity: number | null;
  acceleration?: number | null;
}

export interface SceneArm {
  name: string;
  type: string;
  dof: number;
  joints: string[];
  /** `closed` and `open` are positions of the URDF's joint; `min` and `max` those that `state` reports. */
  gripper: {
    joint: string | null;
    closed: number | null;
    open: number | null;
    min: number | null;
    max: number | null;
  } | null;
}

/** One message of the stream `coordinator_joint_state`. */
export interface JointState {
  tick: number;
  stamp: number;
  name: string[];
  position: (number | null)[];
  velocity: (number | null)[];
  effort: (number | null)[];
}

export interface RunEvent {
  tick: number;
  stamp: number;
  level: 'info' | 'warning' | 'error';
  kind: string;
  text: string;
  /** Who asked for it, if it is the effect of a request. */
  by?: string | null;
}

/** Who made a request. */
export interface Who {
  program: string;
  pid?: number | null;
  user?: string | null;
}

export interface JointReport {
  name: string;
  position: number | null;
  velocity: number | null;
  effort: number | null;
  command: number | null;
}

export interface Pose {
  xyz: Vec3;
  rpy?: Vec3 | null;
  quat?: Quat | null;
}

export interface State {
  tick: number;
  stamp: number;
  arms: {
    hardware_id: string;
    age_ms: number | null;
    joints: JointReport[];
    gripper: number | null;
    gripper_unit: string | null;
    gripper_force: number | null;
    gripper_force_unit: string | null;
    pose: {xyz: Vec3; rpy: Vec3; link: string} | null;
    wrench: number[] | null;
  }[];
}

export interface ArmStatus {
  hardware_id: string;
  adapter: string;
  address: string;
  simulated: boolean;
  link: string;
  phase: string;
  /** What leads it, while it is led. */
  led_by?: string | null;
  /** How it may be led by hand: `hand_guiding` or `motors_off`. */
  teach?: string | null;
  cause: {name: string; text: string; by?: Who | null} | null;
  enabled: boolean;
  mode: string;
  /** Fraction of its speed at which its controller runs motions. */
  speed_fraction?: number | null;
  error: {code: number; text: string} | null;
  state_age_ms: number | null;
  measured_rate_hz: number | null;
  faults: {since: number; over: boolean; count: number; text: string}[];
  /** How its model fits the arm, in words; absent where there is nothing to say. */
  model_notes?: string[];
  commander: {program: string; pid: number | null; held_for: number} | null;
  gripper_range?: [number, number] | null;
  gripper_unit?: string | null;
  gripper_force_range?: [number, number] | null;
  gripper_force_unit?: string | null;
  position_limits: [number, number][];
  stop_pending?: boolean;
  tcp?: {link: string; tool?: {xyz: Vec3; rpy: Vec3} | null} | null;
}

export interface Task {
  name: string;
  type: string;
  joints: string[];
  state: string;
  progress: number | null;
  reason: string | null;
  motion: number | null;
  /** The methods that send it targets. */
  takes?: string[];
  priority?: number;
  /** What limits its motion now. */
  bound?: string | null;
}

/** Reply to `ik`. */
export interface IkReply {
  joints?: number[] | null;
  error?: string | null;
}

export interface Status {
  run: string;
  version: string;
  uptime: number;
  tick_rate: number;
  simulated: boolean;
  ticks: {overruns: number; skipped: number; lateness_us: Record<'p50' | 'p99' | 'p99_9' | 'max', number | null>};
  recorder: {messages: number; dropped: number; error: string | null} | null;
  log: string | null;
  arms: ArmStatus[];
  speed: {fraction: number; paused: boolean};
  tasks: Task[];
  planner: {state: string; error: string | null; robots: string[]; attached: {name: string} | null} | null;
}

export interface PlannerReport {
  robots: {
    name: string;
    joints: string[];
    limits: [number | null, number | null][];
    named_poses: Record<string, number[]>;
    end_effector_link: string;
  }[];
}

export interface PosesReport {
  poses: Record<string, Record<string, Record<string, number>>>;
}

export type Shape = {box: Vec3} | {sphere: number} | {cylinder: [number, number]} | {mesh: string} | {cloud: string};

export interface WorldObject {
  name: string;
  shape: Shape;
  pose: Pose;
  padding: number;
  held_by?: [string, string] | null;
}

export interface PlanSummary {
  joints: string[];
  start: number[];
  goal: number[];
  duration: number;
  length: number;
  clearance: number | null;
  closest: string[] | null;
  fraction?: number | null;
}

export interface PlanningReport {
  plan: number;
  state: 'PLANNING' | 'PLANNED' | 'FAILED' | 'CANCELLED';
  elapsed: number;
  summary?: PlanSummary | null;
  error?: string | null;
  hint?: string | null;
}

export interface Preview {
  plan: number;
  summary: PlanSummary;
  trajectory: {joint_names: string[]; points: {time_from_start: number; positions: number[]}[]};
  end_effectors: Record<string, Vec3[]>;
}

export interface MotionReport {
  motion: number;
  state: string;
  done: boolean;
  progress: number | null;
  elapsed: number;
  remaining: number | null;
  error: string | null;
  deviation?: {joint: string; target: number; actual: number}[] | null;
}

/** Progress or outcome of a motion that the run carries out as a whole. */
export interface GoingReport {
  done: boolean;
  steps: {begun?: {task?: string}; motions?: MotionReport[]}[];
  error?: {code: string; message: string; hint?: string};
}

export interface StopReply {
  arms: Record<string, 'confirmed' | 'sent_not_confirmed' | 'not_sent'>;
}

/** Why a request did not succeed: what the run answered, or `LOST` without an answer. */
export class RpcError extends Error {
  constructor(
    readonly code: string,
    message: string,
    readonly hint?: string,
  ) {
    super(message);
  }
}
