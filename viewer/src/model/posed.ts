// A model whose joints are where people put them. The server says what touches there, and where the tool centre points
// are: it has the kinematics and the collision geometry of plans.
import type {Quat, Scene, SceneRobot, Vec3, WorldObject} from '../protocol';
import type {Server} from '../server';
import {Signal} from '../signal';
import {Still} from '../still';

export interface ModelScene extends Scene {
  objects: WorldObject[];
  /** Pairs of links that are never checked, and why. */
  ignored: [string, string, string][];
  /** Why nothing is checked. */
  unchecked: string | null;
}

export interface Pair {
  links: [string, string];
  /** Negative: penetration depth [m]. */
  distance: number;
}

interface Reply {
  pairs: Pair[];
  tcp: {robot: string; link: string; xyz: Vec3; rpy: Vec3; quat: Quat}[];
}

export class Posed extends Still {
  /** What touches or is close; null while nothing is known. */
  pairs: Pair[] | null = null;
  tcp: Reply['tcp'] = [];
  readonly onReply = new Signal();
  readonly onMove = new Signal();
  trouble: string;
  private readonly positions = new Map<string, number>();
  private asking = false;
  private again = false;

  constructor(
    readonly model: ModelScene,
    private readonly server: Server,
  ) {
    super(model);
    this.trouble = model.unchecked ?? '';
    for (const robot of model.robots) this.reset(robot);
    // A pose that is called home is where people expect the arm.
    for (const robot of model.robots) {
      const home = robot.groups?.home ?? robot.groups?.ready;
      if (home) this.assign(robot, home);
    }
  }

  override start(): void {
    this.world = this.model.objects;
    this.onWorld.emit();
    this.changed();
  }

  position(joint: string): number {
    return this.positions.get(joint) ?? 0;
  }

  limits(robot: SceneRobot, joint: string): [number, number] {
    const {lower, upper} = robot.limits[joint] ?? {lower: null, upper: null};
    return [lower ?? -Math.PI, upper ?? Math.PI];
  }

  move(joint: string, position: number): void {
    this.positions.set(joint, position);
    this.changed();
  }

  pose(robot: SceneRobot, positions: number[]): void {
    this.assign(robot, positions);
    this.changed();
  }

  /** Every joint where it is closest to zero. */
  zero(robot: SceneRobot): void {
    this.reset(robot);
    this.changed();
  }

  private reset(robot: SceneRobot): void {
    for (const joint of Object.keys(robot.joints)) this.positions.set(joint, this.rest(robot, joint));
  }

  private rest(robot: SceneRobot, joint: string): number {
    const [lower, upper] = this.limits(robot, joint);
    return Math.min(upper, Math.max(lower, 0));
  }

  private assign(robot: SceneRobot, positions: number[]): void {
    Object.keys(robot.joints).forEach((joint, i) => {
      if (positions[i] !== undefined) this.positions.set(joint, positions[i]!);
    });
  }

  private changed(): void {
    const name = [...this.positions.keys()];
    const position = [...this.positions.values()];
    this.joints = {tick: 0, stamp: 0, name, position, velocity: [], effort: []};
    this.onJoints.emit(this.joints);
    this.onMove.emit();
    void this.ask();
  }

  /** Asks about the newest positions, one request at a time. */
  private async ask(): Promise<void> {
    if (this.model.unchecked) return;
    this.again = true;
    if (this.asking) return;
    this.asking = true;
    while (this.again) {
      this.again = false;
      const q = this.model.robots.flatMap((robot) => Object.keys(robot.joints).map((joint) => this.position(joint)));
      try {
        ({pairs: this.pairs, tcp: this.tcp} = await this.server.get<Reply>(`/pose?q=${q.join()}`));
        this.trouble = '';
      } catch (error) {
        this.pairs = null;
        this.trouble = error instanceof TypeError ? 'this page is no longer served' : (error as Error).message;
      }
      this.onReply.emit();
    }
    this.asking = false;
  }
}
