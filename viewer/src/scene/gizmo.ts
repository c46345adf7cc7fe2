// The handles that people drag: the pose goal of an arm, or an obstacle.
import {AxesHelper, Group, Mesh, MeshBasicMaterial, type Object3D, SphereGeometry} from 'three';
import {TransformControls} from 'three/addons/controls/TransformControls.js';
import type {Stage} from './stage';

export type Handles = 'translate' | 'rotate';

export class Gizmo {
  /** The marker of a pose goal. */
  readonly marker = new Group();
  private readonly controls: TransformControls;
  private onChange: (() => void) | null = null;

  constructor(private readonly stage: Stage) {
    this.controls = new TransformControls(stage.camera, stage.renderer.domElement);
    this.controls.setSize(0.8);
    this.controls.addEventListener('dragging-changed', (event) => {
      stage.controls.enabled = !event.value;
    });
    this.controls.addEventListener('change', () => stage.invalidate());
    this.controls.addEventListener('objectChange', () => this.onChange?.());
    stage.scene.add(this.controls.getHelper());
    const ball = new Mesh(new SphereGeometry(0.012, 16, 12), new MeshBasicMaterial({color: 0xf5a524}));
    this.marker.add(ball, new AxesHelper(0.12));
    this.marker.visible = false;
    stage.scene.add(this.marker);
  }

  get object(): Object3D | undefined {
    return this.controls.object;
  }

  /** Puts the handles on an object. */
  attach(object: Object3D, handles: Handles, onChange: () => void): void {
    this.onChange = onChange;
    this.controls.setMode(handles);
    // An object is moved along the axes of `map`, and turned about its own.
    this.controls.setSpace(handles === 'rotate' ? 'local' : 'world');
    this.controls.attach(object);
    this.marker.visible = object === this.marker;
    this.stage.invalidate();
  }

  detach(): void {
    this.onChange = null;
    this.controls.detach();
    this.marker.visible = false;
    this.stage.invalidate();
  }
}
