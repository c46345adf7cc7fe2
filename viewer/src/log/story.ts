// Entries of a log other than joint states: events, motions that were accepted, objects of the world. Read once; that of a
// live run is read on.
import type {Vec3, WorldObject} from '../protocol';
import {Signal} from '../signal';
import {
  type LoggedEvent,
  type LogSource,
  lastBefore,
  type Markers,
  type Message,
  poseOf,
  type Trajectory,
} from './source';

const EVENTS = '/dimos/events';
const MOTIONS = '/joint_trajectory';
const MARKERS = '/markers';
const REREAD = 2000; // ms, of a live run's log
const ENDED = ['COMPLETED', 'ABORTED', 'CANCELLED'];

export interface Motion {
  start: number;
  /** When its task ended, otherwise as planned. */
  end: number;
  joints: string[];
  points: {t: number; positions: number[]}[];
  /** The planned way of each tool centre point. */
  lines: Vec3[][];
}

interface Change {
  t: number;
  name: string;
  object: WorldObject | null;
}

export class Story {
  events: Message<LoggedEvent>[] = [];
  /** When motions were accepted [s]. */
  starts: {t: number}[] = [];
  readonly changed = new Signal();
  private changes: Change[] = [];
  private readonly motions = new Map<number, Motion | null>();
  private upTo = -1;

  constructor(private readonly source: LogSource) {}

  async begin(): Promise<void> {
    await this.readOn();
    if (this.source.live) window.setInterval(() => void this.readOn().catch(() => {}), REREAD);
  }

  /** The world at a time, and a number that changes when it does. */
  worldAt(t: number): {key: number; objects: WorldObject[]} {
    const key = lastBefore(this.changes, t);
    const objects = new Map<string, WorldObject>();
    for (const {name, object} of this.changes.slice(0, key + 1)) {
      if (object) objects.set(name, object);
      else objects.delete(name);
    }
    return {key, objects: [...objects.values()]};
  }

  /** The motions in progress at a time; those that are not read yet are read, and announced by `changed`. */
  motionsAt(t: number): Motion[] {
    const last = lastBefore(this.starts, t);
    const found: Motion[] = [];
    // As many arms as a run usually has may be in motion at once.
    for (let i = last; i > last - 4 && i >= 0; i--) {
      const motion = this.motions.get(i);
      if (motion === undefined) void this.readMotion(i);
      else if (motion && t <= motion.end) found.push(motion);
    }
    return found;
  }

  private async readOn(): Promise<void> {
    const from = this.upTo < 0 ? 0 : this.upTo + 1e-6;
    const topics = this.source.topics(EVENTS, MARKERS);
    const [starts, news] = await Promise.all([
      this.source.read(this.source.topics(MOTIONS), {from, bare: true}),
      this.source.read<LoggedEvent | Markers>(topics, {from, without: '"ns":"plan/'}),
    ]);
    this.starts.push(...starts);
    for (const message of news) {
      if (message.topic === EVENTS) this.events.push(message as Message<LoggedEvent>);
      else for (const marker of (message.data as Markers).markers) this.change(message.t, marker);
    }
    this.events.sort((a, b) => a.t - b.t);
    this.changes.sort((a, b) => a.t - b.t);
    this.upTo = Math.max(this.upTo, ...[starts.at(-1), news.at(-1)].map((message) => message?.t ?? -1));
    if (starts.length + news.length || from === 0) this.changed.emit();
  }

  private change(t: number, {ns, type, action, header, pose, scale}: Markers['markers'][number]): void {
    const name = ns.replace(/^world\//, '');
    if (action === 2) return void this.changes.push({t, name, object: null});
    const {x, y, z} = scale;
    const held = header.frame_id === 'map' ? null : (['', header.frame_id] as [string, string]);
    const shape: WorldObject['shape'] | undefined = {
      1: {box: [x, y, z] as Vec3},
      2: {sphere: x / 2},
      3: {cylinder: [x / 2, z] as [number, number]},
    }[type];
    // The file of a mesh or a cloud is not in the log: a marker is where it was.
    const object = {name, shape: shape ?? {mesh: ''}, pose: poseOf(pose), padding: 0, held_by: held};
    this.changes.push({t, name, object});
  }

  private async readMotion(index: number): Promise<void> {
    this.motions.set(index, null);
    const start = this.starts[index]!.t;
    const window = {from: start - 2e-6, to: start + 2e-6};
    const found = await this.source.read<Trajectory | Markers>(this.source.topics(MOTIONS, MARKERS), window);
    const trajectory = found.find(({topic}) => topic === MOTIONS)?.data as Trajectory | undefined;
    if (!trajectory) return;
    const points = trajectory.points.map(({positions, time_from_start: {sec, nanosec}}) => ({
      t: sec + nanosec * 1e-9,
      positions,
    }));
    const markers = found.flatMap(({topic, data}) => (topic === MARKERS ? (data as Markers).markers : []));
    const plans = markers.filter(({ns}) => ns.startsWith('plan/'));
    const task = plans[0]?.ns.slice('plan/'.length);
    const ended = this.events.find(
      ({t, data}) => t > start && data.kind === 'task' && (!task || data.task === task) && ENDED.includes(data.status),
    );
    this.motions.set(index, {
      start,
      end: ended?.t ?? start + (points.at(-1)?.t ?? 0),
      joints: trajectory.joint_names,
      points,
      lines: plans.map((marker) => marker.points.map(({x, y, z}) => [x, y, z] as Vec3)),
    });
    this.changed.emit();
  }
}
