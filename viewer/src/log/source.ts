// Windows of a log: the server reads the chunks that are shown, and of a long window few messages of each topic.
import type {Pose, Scene, Vec3} from '../protocol';
import type {Server} from '../server';

export interface LogScene extends Scene {
  log: {file: string; start: number; length: number; live: boolean; loss: string | null; topics: string[]};
}

export interface Message<T = unknown> {
  topic: string;
  /** Time since the first message of the log [s]. */
  t: number;
  data: T;
}

export interface Joints {
  name: string[];
  position: (number | null)[];
  velocity: (number | null)[];
  effort: (number | null)[];
}

export interface LoggedStatus {
  phase: string;
  cause: string;
  cause_text: string;
  link: string;
  mode: string;
  enabled: boolean;
  error: number;
  error_text: string;
  age: number | null;
}

export interface LoggedPose {
  pose: {position: {x: number; y: number; z: number}; orientation: {x: number; y: number; z: number; w: number}};
}

export interface LoggedEvent {
  kind: string;
  severity: string;
  status: string;
  arm: string;
  task: string;
  text: string;
  /** Who asked for it; absent in logs of earlier versions. */
  by?: string;
}

interface Marker {
  ns: string;
  type: number;
  action: number;
  header: {frame_id: string};
  pose: LoggedPose['pose'];
  scale: {x: number; y: number; z: number};
  points: {x: number; y: number; z: number}[];
}

export interface Markers {
  markers: Marker[];
}

export interface Trajectory {
  joint_names: string[];
  points: {positions: number[]; time_from_start: {sec: number; nanosec: number}}[];
}

interface Options {
  from?: number;
  to?: number;
  points?: number;
  bare?: boolean;
  without?: string;
  signal?: AbortSignal;
}

export class LogSource {
  length: number;
  live: boolean;
  /** What was found missing so far: damage shows where it is read. */
  loss: string | null;

  constructor(
    readonly scene: LogScene,
    private readonly server: Server,
  ) {
    ({length: this.length, live: this.live, loss: this.loss} = scene.log);
  }

  /** The topics of a kind that this log has: `/tcp/` gives one for each arm. */
  topics(...kinds: string[]): string[] {
    const is = (topic: string, kind: string) => topic === kind || (kind.endsWith('/') && topic.startsWith(kind));
    return this.scene.log.topics.filter((topic) => kinds.some((kind) => is(topic, kind)));
  }

  async read<T>(topics: string[], options: Options): Promise<Message<T>[]> {
    if (!topics.length) return [];
    const {from, to, points, bare, without, signal} = options;
    const query = [`topics=${topics.join()}`];
    if (from !== undefined) query.push(`from=${from.toFixed(6)}`);
    if (to !== undefined) query.push(`to=${to.toFixed(6)}`);
    if (points) query.push(`points=${points}`);
    if (bare) query.push('bare=1');
    if (without) query.push(`without=${without}`);
    interface Reply {
      length: number;
      live: boolean;
      loss: string | null;
      messages: Message<T>[];
    }
    const reply = await this.server.get<Reply>(`/messages?${query.join('&')}`, signal);
    this.length = reply.length;
    this.live = reply.live;
    this.loss = reply.loss;
    return reply.messages;
  }
}

/** The index of the last message up to a time; −1 before the first. */
export function lastBefore(messages: {t: number}[], t: number): number {
  let [low, high] = [0, messages.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (messages[middle]!.t <= t) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

export function poseOf({position: p, orientation: q}: LoggedPose['pose']): Required<Pick<Pose, 'quat' | 'xyz'>> {
  return {xyz: [p.x, p.y, p.z] as Vec3, quat: [q.x, q.y, q.z, q.w]};
}
