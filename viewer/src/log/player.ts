// A log that is played: the run as it was at a time. It reads blocks of ten seconds, and keeps the last ones.
import {Euler, Quaternion} from 'three';
import type {ArmStatus, Vec3} from '../protocol';
import {Signal} from '../signal';
import {Still} from '../still';
import {
  type Joints,
  type LoggedPose,
  type LoggedStatus,
  type LogSource,
  lastBefore,
  type Message,
  poseOf,
} from './source';
import type {Story} from './story';

const BLOCK = 10; // s
const PER_BLOCK = 500; // messages of each topic
const KEPT = 40; // blocks
const SETTLE = 130; // ms: panels leave out what comes faster

interface Block {
  joints: Message<Joints>[];
  commands: Message<Joints>[];
  status: Map<string, Message<LoggedStatus>[]>;
  tcp: Map<string, Message<LoggedPose>[]>;
  /** What a live run may still add to. */
  open: boolean;
}

export class Player extends Still {
  time = 0;
  rate = 1;
  playing = false;
  readonly onTime = new Signal();
  private readonly blocks = new Map<number, Block | Promise<void>>();
  private worldKey = -2;
  private settled = 0;
  private failed = '';

  constructor(
    readonly source: LogSource,
    readonly story: Story,
  ) {
    super(source.scene);
    story.changed.on(() => {
      this.worldKey = -2;
      this.show();
    });
  }

  seek(time: number): void {
    this.time = Math.min(this.source.length, Math.max(0, time));
    this.show();
    window.clearTimeout(this.settled);
    this.settled = window.setTimeout(() => this.show(), SETTLE);
  }

  play(playing: boolean): void {
    if (this.playing === playing) return;
    this.playing = playing;
    if (playing && this.time >= this.source.length && !this.source.live) this.time = 0;
    this.onTime.emit();
    let last = performance.now();
    const step = (now: number) => {
      if (!this.playing) return;
      // Waits for messages that are not read yet.
      const passed = (Math.max(0, now - last) / 1000) * this.rate;
      if (this.block(this.time)) this.time = Math.min(this.source.length, this.time + passed);
      last = now;
      this.block(this.time + this.rate * 2);
      this.show();
      if (this.time >= this.source.length && !this.source.live) this.play(false);
      else requestAnimationFrame(step);
    };
    if (playing) requestAnimationFrame(step);
    else this.seek(this.time);
  }

  /** The measured way of the tool centre points between two times, as far as it was read. */
  ways(from: number, to: number): Vec3[][] {
    const ways = new Map<string, Vec3[]>();
    for (let at = Math.floor(from / BLOCK); at <= Math.floor(to / BLOCK); at++) {
      const block = this.blocks.get(at);
      if (!block || block instanceof Promise) continue;
      for (const [arm, poses] of block.tcp) {
        const way = ways.get(arm) ?? [];
        ways.set(arm, way);
        for (const {t, data} of poses) if (t >= from && t <= to) way.push(poseOf(data.pose).xyz);
      }
    }
    return [...ways.values()];
  }

  /** The block with a time, if it is there; otherwise it is read. */
  private block(time: number): Block | null {
    const index = Math.floor(Math.min(time, this.source.length) / BLOCK);
    const found = this.blocks.get(index);
    if (found instanceof Promise) return null;
    if (found && !(found.open && this.outdated(found))) return found;
    // While people drag the timeline, only few places are read at once.
    if ([...this.blocks.values()].filter((each) => each instanceof Promise).length < 3) {
      const reading = this.read(index).then(
        (block) => {
          this.blocks.set(index, block);
          this.show();
        },
        (error: Error) => {
          this.failed = error instanceof TypeError ? 'no connection: this page is no longer served' : error.message;
          this.onTime.emit();
          window.setTimeout(() => this.blocks.delete(index), 1000);
        },
      );
      this.blocks.set(index, reading);
      for (const key of this.blocks.keys()) if (this.blocks.size > KEPT && key !== index) this.blocks.delete(key);
    }
    return found ?? null;
  }

  private outdated(block: Block): boolean {
    return this.source.length - (block.joints.at(-1)?.t ?? 0) > 0.3;
  }

  private async read(index: number): Promise<Block> {
    const {source} = this;
    const topics = source.topics('/joint_states', '/joint_commands', '/tcp/', '/arm_status/');
    const [from, to] = [index * BLOCK, (index + 1) * BLOCK];
    const messages = await source.read<unknown>(topics, {from, to: to - 1e-6, points: PER_BLOCK});
    const of = <T>(kind: string) => messages.filter(({topic}) => topic === kind) as Message<T>[];
    const each = <T>(kind: string) => {
      const own = source.topics(kind);
      return new Map(own.map((topic) => [topic.slice(kind.length), of<T>(topic)] as const));
    };
    this.failed = '';
    return {
      joints: of<Joints>('/joint_states'),
      commands: of<Joints>('/joint_commands'),
      status: each<LoggedStatus>('/arm_status/'),
      tcp: each<LoggedPose>('/tcp/'),
      open: source.live && to > source.length,
    };
  }

  /** Why nothing can be read; empty if it can. */
  get trouble(): string {
    return this.failed;
  }

  private show(): void {
    const {time} = this;
    const world = this.story.worldAt(time);
    if (world.key !== this.worldKey) {
      this.worldKey = world.key;
      this.world = world.objects;
      this.onWorld.emit();
    }
    const block = this.block(time);
    if (block) this.take(block);
    this.onTime.emit();
  }

  private take(block: Block): void {
    const {time, scene} = this;
    const at = <T>(messages: Message<T>[]) => messages[Math.max(0, lastBefore(messages, time))];
    const index = Math.max(0, lastBefore(block.joints, time));
    const [now, next] = [block.joints[index], block.joints[index + 1]];
    if (!now) return;
    // Between two messages the arm is between two positions.
    const part = next && next.t > now.t ? Math.min(1, Math.max(0, (time - now.t) / (next.t - now.t))) : 0;
    const place = (i: number) => {
      const [name, names] = [now.data.name[i]!, next?.data.name ?? []];
      return names[i] === name ? i : names.indexOf(name);
    };
    const position = now.data.position.map((value, i) => {
      const other = next?.data.position[place(i)];
      return typeof value === 'number' && typeof other === 'number' ? value + part * (other - value) : value;
    });
    const stamp = this.source.scene.log.start + time;
    this.joints = {tick: 0, stamp, ...now.data, position};
    this.onJoints.emit(this.joints);
    const command = at(block.commands);
    // A command is sent in every tick of a motion: an old one is over.
    const commands = command && Math.abs(command.t - now.t) < 0.1 ? command.data : null;
    const value = (list: (number | null)[] | undefined, i: number) => (i < 0 ? null : (list?.[i] ?? null));
    this.state = {
      tick: 0,
      stamp,
      arms: scene.arms.map(({name, joints}) => {
        const tcp = at(block.tcp.get(name) ?? [])?.data;
        const pose = tcp && poseOf(tcp.pose);
        const turn = pose && new Euler().setFromQuaternion(new Quaternion(...pose.quat!), 'ZYX');
        return {
          hardware_id: name,
          age_ms: 0,
          joints: joints.map((joint) => {
            const [own, other] = [now.data.name.indexOf(joint), commands?.name.indexOf(joint) ?? -1];
            return {
              name: joint,
              position: value(position, own),
              velocity: value(now.data.velocity, own),
              effort: value(now.data.effort, own),
              command: value(commands?.position, other),
            };
          }),
          gripper: null,
          gripper_unit: null,
          gripper_force: null,
          gripper_force_unit: null,
          pose: pose ? {xyz: pose.xyz, rpy: [turn!.x, turn!.y, turn!.z], link: ''} : null,
          wrench: null,
        };
      }),
    };
    this.onState.emit(this.state);
    this.status = {
      run: scene.name,
      version: '',
      uptime: 0,
      tick_rate: 0,
      simulated: true,
      ticks: {overruns: 0, skipped: 0, lateness_us: {p50: null, p99: null, p99_9: null, max: null}},
      recorder: null,
      log: null,
      speed: {fraction: 1, paused: false},
      tasks: [],
      planner: null,
      arms: scene.arms.map(({name}) => statusOf(name, at(block.status.get(name) ?? [])?.data)),
    };
    this.onStatus.emit(this.status);
  }
}

function statusOf(name: string, logged: LoggedStatus | undefined): ArmStatus {
  return {
    hardware_id: name,
    adapter: '',
    address: '',
    simulated: true,
    link: logged?.link ?? 'up',
    phase: logged?.phase ?? 'unknown',
    cause: logged?.cause_text ? {name: logged.cause, text: logged.cause_text} : null,
    enabled: logged?.enabled ?? false,
    mode: logged?.mode ?? '',
    error: logged?.error ? {code: logged.error, text: logged.error_text} : null,
    state_age_ms: typeof logged?.age === 'number' ? logged.age * 1000 : null,
    measured_rate_hz: null,
    faults: [],
    commander: null,
    position_limits: [],
  };
}
