// The goals that people set up, one per arm: joints (by sliders or a named pose), or a pose (by the handles); and the
// waypoints before it. Goals of several arms are planned together.
import {Quaternion, Vector3} from 'three';
import type {Context} from './context';
import type {Goal, PlanRequest} from './flow';
import type {Vec3} from './protocol';
import {Reach} from './reach';
import type {Handles} from './scene/gizmo';
import {quaternionOf} from './scene/robot';
import {Signal} from './signal';
import {figure} from './units';

export type Mode = 'joints' | 'pose';

/** A goal that was kept as a waypoint. */
export interface Waypoint {
  goal: Goal;
  text: string;
}

/** The goal of one arm, as far as it is set. */
class Draft {
  mode: Mode = 'joints';
  /** Joint goal [rad], in the order of the arm's joints; null until people change it. */
  joints: number[] | null = null;
  named: string | null = null;
  /** Whether people have changed the goal since it was where the arm is. */
  edited = false;
  /** Pose goal in `map`. */
  position = new Vector3();
  quaternion = new Quaternion();
  /** Orientation of a pose goal is left to the planner. */
  freeOrientation = false;
  linear = false;
  waypoints: Waypoint[] = [];
}

export class GoalEditor {
  handles: Handles = 'translate';
  /** How far the tool centre point may pass waypoints [m]. */
  blend = 0;
  readonly changed = new Signal();
  /** People changed a goal. */
  readonly onEdit = new Signal();
  /** Inverse kinematics of the pose that is dragged. */
  readonly reach: Reach;
  private readonly drafts = new Map<string, Draft>();

  constructor(private readonly context: Context) {
    this.reach = new Reach(context.run);
    this.reach.changed.on(() => this.showGhost());
    context.onSelect.on(() => {
      // The goals of other arms stay: they are planned together.
      if (!this.edited && !this.waypoints.length) this.reset();
      this.reach.clear();
      if (this.edited && this.mode === 'pose') this.askReach();
      this.show();
    });
  }

  private get draft(): Draft {
    const arm = this.context.selected;
    if (!this.drafts.has(arm)) this.drafts.set(arm, new Draft());
    return this.drafts.get(arm)!;
  }

  get mode(): Mode {
    return this.draft.mode;
  }

  get joints(): number[] | null {
    return this.draft.joints;
  }

  get named(): string | null {
    return this.draft.named;
  }

  get edited(): boolean {
    return this.draft.edited;
  }

  get waypoints(): Waypoint[] {
    return this.draft.waypoints;
  }

  get robot() {
    return this.context.robotOf(this.context.selected);
  }

  get freeOrientation(): boolean {
    return this.draft.freeOrientation;
  }

  get linear(): boolean {
    return this.draft.linear;
  }

  setFreeOrientation(on: boolean): void {
    this.draft.freeOrientation = on;
    if (this.edited) this.edit();
  }

  setLinear(on: boolean): void {
    this.draft.linear = on;
    if (this.edited) this.edit();
  }

  /** The coordinator's joints of a joint goal, in its order. */
  get names(): string[] {
    const {run} = this.context;
    const planned = run.planner?.robots.find((robot) => robot.name === this.robot?.name);
    return planned?.joints ?? this.context.arm?.joints ?? [];
  }

  present(): number[] {
    return this.names.map((joint) => this.context.position(joint) ?? 0);
  }

  setJoint(index: number, value: number): void {
    const {draft} = this;
    draft.joints = draft.joints ?? this.present();
    draft.joints[index] = value;
    draft.named = null;
    this.edit();
    this.showGhost();
  }

  /** Named poses of the blueprint, and those that people saved: name → positions. */
  namedPoses(): Map<string, number[]> {
    const poses = new Map(
      Object.entries(
        this.context.run.planner?.robots.find((robot) => robot.name === this.robot?.name)?.named_poses ??
          this.robot?.groups ??
          {},
      ),
    );
    for (const [name, arms] of Object.entries(this.context.run.poses)) {
      const joints = arms[this.context.selected];
      const values = this.names.map((joint) => joints?.[joint]);
      if (values.every((value) => typeof value === 'number')) poses.set(name, values as number[]);
    }
    return poses;
  }

  setNamed(name: string): void {
    const values = this.namedPoses().get(name);
    if (!values) return;
    this.draft.joints = [...values];
    this.draft.named = name;
    this.edit();
    this.showGhost();
  }

  setMode(mode: Mode): void {
    this.draft.mode = mode;
    this.reset();
  }

  setHandles(handles: Handles): void {
    this.handles = handles;
    this.showHandles();
  }

  /** Back to where the arm is. */
  reset(): void {
    const {draft} = this;
    draft.joints = draft.named = null;
    draft.edited = false;
    this.reach.clear();
    if (draft.mode === 'pose') this.placeMarker();
    this.show();
  }

  /** Drops the goals of all arms, and all waypoints. */
  clear(): void {
    for (const [arm, {mode}] of this.drafts) {
      const draft = new Draft();
      draft.mode = mode;
      this.drafts.set(arm, draft);
    }
    this.reset();
  }

  /** Drops the goal of one arm. */
  drop(arm: string): void {
    const draft = this.drafts.get(arm);
    if (!draft) return;
    draft.joints = draft.named = null;
    draft.edited = false;
    if (arm === this.context.selected) this.reset();
    this.onEdit.emit();
    this.show();
  }

  /** Keeps the present goal as the next waypoint. */
  addWaypoint(): void {
    const goal = this.goal();
    if (!goal) return;
    this.waypoints.push({goal, text: this.text()});
    this.draft.edited = false;
    this.draft.named = null;
    this.onEdit.emit();
    this.changed.emit();
  }

  removeWaypoint(index: number): void {
    this.waypoints.splice(index, 1);
    this.onEdit.emit();
    this.changed.emit();
  }

  /** Shows the goals in the view. */
  show(): void {
    this.showHandles();
    this.showGhost();
  }

  /** Hides what shows the goals: a plan takes their place. */
  hide(): void {
    for (const robot of this.context.view.robots.values()) robot.setGhost('goal', null);
    this.context.gizmo.detach();
  }

  pose(): {xyz: Vec3; rpy: Vec3} {
    const {position, quaternion} = this.draft;
    return {xyz: position.toArray(), rpy: rpyOf(quaternion)};
  }

  setPose(xyz: Vec3, rpy: Vec3): void {
    this.draft.position.set(...xyz);
    this.draft.quaternion.copy(quaternionOf(rpy));
    this.showHandles();
    this.edit();
  }

  /** The goal of the selected arm as the planner takes it; null if there is none yet. */
  goal(): Goal | null {
    return this.draft.edited ? this.goalOf(this.context.selected, this.draft) : null;
  }

  /** In words. */
  text(arm = this.context.selected): string {
    const draft = this.drafts.get(arm);
    if (!draft) return '';
    if (draft.mode === 'joints') return draft.named ?? 'joints';
    const {x, y, z} = draft.position;
    return `${draft.linear ? 'line to ' : ''}${[x, y, z].map((value) => figure(value, 3)).join(' ')} m`;
  }

  /** The arms that have a goal or waypoints. */
  get arms(): string[] {
    return [...this.drafts].filter(([, {edited, waypoints}]) => edited || waypoints.length).map(([arm]) => arm);
  }

  /** All goals and waypoints as one request to the planner; or why there is none. */
  request(speed: number): PlanRequest | string {
    const {arms} = this;
    if (!arms.length) return 'no goal yet';
    const passing = arms.filter((arm) => this.drafts.get(arm)!.waypoints.length);
    if (passing.length && arms.length > 1)
      return `waypoints are for one arm alone: remove those of ${passing[0]}, or the other goals`;
    const goals: Goal[] = [];
    const through: Goal[] = [];
    for (const arm of arms) {
      const draft = this.drafts.get(arm)!;
      through.push(...draft.waypoints.map(({goal}) => goal));
      // Without a goal after them, the last waypoint is the goal.
      goals.push(draft.edited ? this.goalOf(arm, draft) : through.pop()!);
    }
    return {goals, speed, ...(through.length ? {through, blend: this.blend} : {})};
  }

  private goalOf(arm: string, draft: Draft): Goal {
    const robot = this.context.robotOf(arm)?.name ?? arm;
    if (draft.mode === 'joints') return draft.named ? {robot, named: draft.named} : {robot, joints: [...draft.joints!]};
    const {position, quaternion, freeOrientation, linear} = draft;
    // What the ghost shows, unless it touches something: then the planner looks for another configuration.
    if (!linear && draft.joints) return {robot, joints: [...draft.joints]};
    const pose = {xyz: position.toArray() as Vec3};
    const quat = quaternion.toArray() as [number, number, number, number];
    return {robot, pose: freeOrientation ? pose : {...pose, quat}, ...(linear ? {linear: true} : {})};
  }

  private edit(): void {
    this.draft.edited = true;
    if (this.mode === 'pose') this.askReach();
    this.onEdit.emit();
    this.changed.emit();
  }

  private askReach(): void {
    const {draft} = this;
    const robot = this.robot?.name;
    if (!robot || !this.context.run.planner) return;
    draft.joints = null;
    const pose = {xyz: draft.position.toArray() as Vec3};
    const quat = draft.quaternion.toArray() as [number, number, number, number];
    this.reach.ask({robot, pose: draft.freeOrientation ? pose : {...pose, quat}}, this.present(), ({joints, error}) => {
      draft.joints = joints && !error ? joints : null;
      this.changed.emit();
    });
  }

  private placeMarker(): void {
    const {position, quaternion} = this.context.view.tcp(this.robot?.name ?? '');
    this.draft.position.copy(position);
    this.draft.quaternion.copy(quaternion);
  }

  private showHandles(): void {
    const {gizmo, view} = this.context;
    const {draft} = this;
    if (draft.mode !== 'pose') {
      if (gizmo.object === gizmo.marker) gizmo.detach();
      return;
    }
    gizmo.marker.position.copy(draft.position);
    gizmo.marker.quaternion.copy(draft.quaternion);
    gizmo.attach(gizmo.marker, this.handles, () => {
      draft.position.copy(gizmo.marker.position);
      draft.quaternion.copy(gizmo.marker.quaternion);
      this.edit();
    });
    view.stage.invalidate();
  }

  private showGhost(): void {
    const ghosts = new Map<string, {joints: number[]; names: string[]; bad: boolean}>();
    for (const [arm, draft] of this.drafts) {
      const name = this.context.robotOf(arm)?.name;
      const names = this.context.run.planner?.robots.find((robot) => robot.name === name)?.joints;
      const own = arm === this.context.selected;
      const dragged = own && draft.mode === 'pose' && draft.edited ? this.reach.joints : null;
      const joints = dragged ?? draft.joints;
      if (!name || !joints) continue;
      ghosts.set(name, {joints, names: names ?? this.names, bad: dragged !== null && this.reach.problem !== null});
    }
    for (const robot of this.context.view.robots.values()) {
      const ghost = ghosts.get(robot.model.name);
      robot.setGhost('goal', ghost ? (joint) => ghost.joints[ghost.names.indexOf(joint)] : null, ghost?.bad);
    }
    this.changed.emit();
  }
}

/** Roll, pitch, yaw about fixed axes [rad]. */
export function rpyOf(quaternion: Quaternion): Vec3 {
  const x = new Vector3(1, 0, 0).applyQuaternion(quaternion);
  const y = new Vector3(0, 1, 0).applyQuaternion(quaternion);
  const z = new Vector3(0, 0, 1).applyQuaternion(quaternion);
  const pitch = Math.asin(Math.max(-1, Math.min(1, -x.z)));
  return [Math.atan2(y.z, z.z), pitch, Math.atan2(x.y, x.x)];
}
