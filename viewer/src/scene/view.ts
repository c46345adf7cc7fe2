// The arms of the run in the 3D view: measured joints, goals and plans as ghosts, traces, obstacles.
import {type Line, Quaternion, Vector3} from 'three';
import type {Context} from '../context';
import type {Preview} from '../protocol';
import {Labels} from './labels';
import {Meshes} from './meshes';
import {Obstacles} from './obstacles';
import {Robot} from './robot';
import {dispose, type Stage} from './stage';
import {planLine, Trace} from './trace';

/** Smallest motion of a joint for which a frame is drawn [rad]: noise at rest is less. */
const SMALLEST = 1e-5;
const TRACE_COLORS = [0xe5484d, 0x30a46c, 0xab6bff, 0xf5a524];

export class View {
  readonly robots = new Map<string, Robot>();
  readonly obstacles: Obstacles;
  private readonly traces = new Map<string, Trace>();
  private readonly planLines: Line[] = [];
  private fresh = false;
  private drawn: number[] = [];
  private readonly point = new Vector3();
  private readonly turn = new Quaternion();

  constructor(
    readonly stage: Stage,
    private readonly context: Context,
    token: string,
  ) {
    const {run} = context;
    const meshes = new Meshes(token);
    const changed = () => stage.invalidate();
    const labels = new Labels(stage, (name) => context.select(name));
    run.scene.robots.forEach((model, index) => {
      const robot = new Robot(model, meshes, changed);
      const trace = new Trace(TRACE_COLORS[index % TRACE_COLORS.length]!);
      this.robots.set(model.name, robot);
      this.traces.set(model.name, trace);
      stage.content.add(robot.group);
      stage.scene.add(trace.line);
    });
    for (const {name, joints} of run.scene.arms.length > 1 ? run.scene.arms : []) {
      const robot = this.robots.get(context.robotOf(name)?.name ?? '');
      if (robot) labels.add(name, run.scene.robots.length > 1 ? robot.group : robot.baseOf(joints[0]));
    }
    labels.choose(context.selected);
    context.onSelect.on(() => labels.choose(context.selected));
    this.obstacles = new Obstacles(
      stage.content,
      // In a log all robots are one.
      (robot, link) => (this.robots.get(robot) ?? [...this.robots.values()][0])?.linkNamed(link) ?? null,
      changed,
      meshes,
    );
    run.onJoints.on(({position}) => {
      const moved = position.some((value, i) => Math.abs((value ?? 0) - (this.drawn[i] ?? Infinity)) > SMALLEST);
      if (!moved) return;
      this.drawn = position.map((value) => value ?? 0);
      this.fresh = true;
      stage.invalidate();
    });
    run.onState.on(() => {
      this.moveFingers();
      for (const {name} of run.scene.arms)
        this.robots.get(context.robotOf(name)?.name ?? '')?.setStale(run.armStale(name));
    });
    run.onWorld.on(() => this.obstacles.show(run.world));
    run.onStatus.on((status) => {
      for (const [name, robot] of this.robots) {
        robot.setTool(status.arms.find((arm) => context.robotOf(arm.hardware_id)?.name === name)?.tcp);
      }
    });
    stage.onFrame.on(() => this.frame());
  }

  /** Pose of an arm's tool centre point as it is drawn. */
  tcp(robot: string): {position: Vector3; quaternion: Quaternion} {
    const [position, quaternion] = [new Vector3(), new Quaternion()];
    this.robots.get(robot)?.tcp(position, quaternion);
    return {position, quaternion};
  }

  showTraces(visible: boolean): void {
    for (const trace of this.traces.values()) {
      trace.line.visible = visible;
      trace.clear();
    }
    this.stage.invalidate();
  }

  /** The way of the tool centre points of a plan, or none. */
  showPlanLine(preview: Preview | null): void {
    for (const line of this.planLines.splice(0)) {
      line.removeFromParent();
      dispose(line);
    }
    for (const points of Object.values(preview?.end_effectors ?? {})) {
      const line = planLine(points);
      this.planLines.push(line);
      this.stage.scene.add(line);
    }
    this.stage.invalidate();
  }

  /** The arms of a plan at a time of it. */
  showPlan(preview: Preview | null, time: number): void {
    const positions = preview ? at(preview, time) : null;
    for (const robot of this.robots.values()) {
      const moves = positions && preview!.summary.joints.some((joint) => joint in robot.model.joints);
      robot.setGhost('plan', moves ? (joint) => positions.get(joint) : null);
    }
  }

  private frame(): void {
    if (!this.fresh) return;
    this.fresh = false;
    for (const [name, robot] of this.robots) {
      robot.setJoints((joint) => this.context.position(joint));
      robot.tcp(this.point, this.turn);
      const trace = this.traces.get(name)!;
      if (trace.line.visible) trace.add(this.point);
    }
    this.stage.fitOnce();
  }

  private moveFingers(): void {
    const {run} = this.context;
    for (const {name, gripper} of run.scene.arms) {
      const position = run.armState(name)?.gripper;
      const robot = this.robots.get(this.context.robotOf(name)?.name ?? '');
      if (!robot || !gripper?.joint || typeof position !== 'number') continue;
      const {min, max, closed, open} = gripper;
      if (min === null || max === null || closed === null || open === null || min === max) continue;
      const joint = closed + ((position - min) / (max - min)) * (open - closed);
      if (robot.setFinger(gripper.joint, joint)) this.stage.invalidate();
    }
  }
}

/** Joint positions of a plan at a time, between its points. */
export function at({trajectory}: Preview, time: number): Map<string, number> {
  const {points, joint_names} = trajectory;
  let next = points.findIndex((point) => point.time_from_start >= time);
  if (next < 0) next = points.length - 1;
  const [a, b] = [points[Math.max(0, next - 1)]!, points[next]!];
  const span = b.time_from_start - a.time_from_start;
  const fraction = span > 0 ? Math.min(1, Math.max(0, (time - a.time_from_start) / span)) : 1;
  return new Map(
    joint_names.map((joint, i) => [joint, a.positions[i]! + fraction * (b.positions[i]! - a.positions[i]!)] as const),
  );
}
