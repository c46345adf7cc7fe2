// The goal that people set up for the selected arm: joints (by sliders or a named pose), or a pose (by the handles).
import {Quaternion, Vector3} from 'three';
import {type Context} from './context';
import {type Goal} from './flow';
import {type Vec3} from './protocol';
import {type Handles} from './scene/gizmo';
import {quaternionOf} from './scene/robot';
import {Signal} from './signal';

export type Mode = 'joints' | 'pose';

export class GoalEditor {
  mode: Mode = 'joints';
  handles: Handles = 'translate';
  /** Orientation of a pose goal is left to the planner. */
  freeOrientation = false;
  linear = false;
  /** Joint goal [rad], in the order of the arm's joints; null until people change it. */
  joints: number[] | null = null;
  named: string | null = null;
  /** Whether people have changed the goal since it was where the arm is. */
  edited = false;
  readonly changed = new Signal();
  /** People changed the goal. */
  readonly onEdit = new Signal();

  constructor(private readonly context: Context) {
    context.onSelect.on(() => this.reset());
  }

  get robot() {
    return this.context.robotOf(this.context.selected);
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
    this.joints = this.joints ?? this.present();
    this.joints[index] = value;
    this.named = null;
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
    this.joints = [...values];
    this.named = name;
    this.edit();
    this.showGhost();
  }

  setMode(mode: Mode): void {
    this.mode = mode;
    this.reset();
  }

  setHandles(handles: Handles): void {
    this.handles = handles;
    this.showHandles();
  }

  /** Back to where the arm is. */
  reset(): void {
    this.joints = this.named = null;
    this.edited = false;
    if (this.mode === 'pose') this.placeMarker();
    this.show();
  }

  /** Shows the goal in the view. */
  show(): void {
    this.showHandles();
    this.showGhost();
  }

  /** Hides what shows the goal: a plan takes its place. */
  hide(): void {
    for (const robot of this.context.view.robots.values()) robot.setGhost('goal', null);
    this.context.gizmo.detach();
  }

  pose(): {xyz: Vec3; rpy: Vec3} {
    const {position, quaternion} = this.context.gizmo.marker;
    return {xyz: position.toArray(), rpy: rpyOf(quaternion)};
  }

  setPose(xyz: Vec3, rpy: Vec3): void {
    const {marker} = this.context.gizmo;
    marker.position.set(...xyz);
    marker.quaternion.copy(quaternionOf(rpy));
    this.edit();
    this.context.view.stage.invalidate();
    this.changed.emit();
  }

  /** The goal as the planner takes it; null if there is none yet. */
  goal(): Goal | null {
    if (!this.edited) return null;
    const robot = this.robot?.name ?? this.context.selected;
    if (this.mode === 'joints') {
      if (this.named) return {robot, named: this.named};
      return this.joints ? {robot, joints: this.joints} : null;
    }
    const {position, quaternion} = this.context.gizmo.marker;
    const pose = {xyz: position.toArray() as Vec3};
    const quat = quaternion.toArray() as [number, number, number, number];
    return {robot, pose: this.freeOrientation ? pose : {...pose, quat}, ...(this.linear ? {linear: true} : {})};
  }

  private edit(): void {
    this.edited = true;
    this.onEdit.emit();
  }

  private placeMarker(): void {
    const {position, quaternion} = this.context.view.tcp(this.robot?.name ?? '');
    this.context.gizmo.marker.position.copy(position);
    this.context.gizmo.marker.quaternion.copy(quaternion);
  }

  private showHandles(): void {
    const {gizmo} = this.context;
    if (this.mode === 'pose')
      gizmo.attach(gizmo.marker, this.handles, () => {
        this.edit();
        this.changed.emit();
      });
    else if (gizmo.object === gizmo.marker) gizmo.detach();
  }

  private showGhost(): void {
    const {joints, names} = this;
    for (const robot of this.context.view.robots.values()) {
      const own = robot.model === this.robot && joints;
      robot.setGhost('goal', own ? (joint) => joints[names.indexOf(joint)] : null);
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
