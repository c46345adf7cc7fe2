// State that all panels share.
import {Flow} from './flow';
import {History} from './history';
import {RpcError, type SceneArm, type SceneRobot} from './protocol';
import type {Run} from './run';
import type {Gizmo} from './scene/gizmo';
import type {View} from './scene/view';
import {Signal} from './signal';
import {Stop} from './stop';

export interface Notice {
  text: string;
  hint?: string;
}

export class Context {
  readonly flow: Flow;
  readonly stop: Stop;
  readonly history: History;
  /** The arm that the joint table, the plots and the motion panel are for. */
  selected = '';
  readonly onSelect = new Signal();
  /** Another tab of panels was opened. */
  readonly onTab = new Signal();
  readonly onNotice = new Signal<Notice | null>();
  view!: View;
  gizmo!: Gizmo;

  constructor(readonly run: Run) {
    this.flow = new Flow(run);
    this.stop = new Stop(run);
    this.history = new History(run.scene.arms, () => (run.status ? 1 / run.status.tick_rate : null));
    this.selected = run.scene.arms[0]?.name ?? '';
  }

  select(arm: string): void {
    if (arm === this.selected) return;
    this.selected = arm;
    this.onSelect.emit();
  }

  get arm(): SceneArm | undefined {
    return this.run.scene.arms.find((arm) => arm.name === this.selected);
  }

  /** The model of an arm: the robot with its joints. */
  robotOf(arm: string): SceneRobot | undefined {
    const joints = this.run.scene.arms.find((each) => each.name === arm)?.joints ?? [];
    return (
      this.run.scene.robots.find((robot) => robot.name === arm) ??
      this.run.scene.robots.find((robot) => joints.some((joint) => joint in robot.joints))
    );
  }

  /** The newest measured position of a joint. */
  position(joint: string): number | null {
    const joints = this.run.joints;
    const index = joints ? joints.name.indexOf(joint) : -1;
    return joints?.position[index] ?? null;
  }

  /** Sends a request that people asked for; what goes wrong is shown. */
  async act<T>(method: string, params: object): Promise<T | null> {
    this.onNotice.emit(null);
    try {
      return await this.run.work.request<T>(method, params);
    } catch (error) {
      this.report(error);
      return null;
    }
  }

  report(error: unknown): void {
    const known = error instanceof RpcError;
    this.onNotice.emit({text: known ? error.message : String(error), hint: known ? error.hint : undefined});
  }
}
