// The 3D view: camera, lights, grid, and frames that are drawn only when something changed.
import {
  AmbientLight,
  AxesHelper,
  Box3,
  Color,
  DirectionalLight,
  GridHelper,
  Group,
  HemisphereLight,
  type Object3D,
  PerspectiveCamera,
  Scene as ThreeScene,
  Vector3,
  WebGLRenderer,
} from 'three';
import {OrbitControls} from 'three/addons/controls/OrbitControls.js';
import {Signal} from '../signal';

const FIELD_OF_VIEW = 40; // degrees

/** Where the camera looks from. */
export const VIEWS = {
  iso: new Vector3(1.2, -1.5, 0.85),
  front: new Vector3(1, 0, 0.12),
  side: new Vector3(0, -1, 0.12),
  top: new Vector3(-0.001, 0, 1),
};

export class Stage {
  readonly scene = new ThreeScene();
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 100);
  readonly renderer: WebGLRenderer;
  readonly controls: OrbitControls;
  /** What the camera is fitted to. */
  readonly content = new Group();
  /** Before a frame is drawn: moving parts take their newest places. */
  readonly onFrame = new Signal();
  /** Frames drawn, and time of the page's own code in them [ms]; for tests. */
  readonly measured = {frames: 0, script: 0, longest: 0};

  private requested = false;
  private fitted = false;
  private readonly grid = new Group();
  private readonly scheme = matchMedia('(prefers-color-scheme: dark)');

  constructor(readonly element: HTMLElement) {
    this.renderer = new WebGLRenderer({antialias: true, powerPreference: 'low-power'});
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    element.append(this.renderer.domElement);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener('change', () => this.invalidate());
    const sun = new DirectionalLight(0xffffff, 1.9);
    sun.position.set(1.5, -2, 4);
    const fill = new DirectionalLight(0xffffff, 0.5);
    fill.position.set(-2, 2, 1);
    this.scene.add(
      this.content,
      this.grid,
      sun,
      fill,
      new HemisphereLight(0xffffff, 0x8d8d99, 1.1),
      new AmbientLight(0xffffff, 0.25),
    );
    this.recolour();
    this.scheme.addEventListener('change', () => this.recolour());
    new ResizeObserver(() => this.resize()).observe(element);
    this.look('iso');
  }

  /** Draws a frame soon. */
  invalidate(): void {
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame(() => this.draw());
  }

  private draw(): void {
    this.requested = false;
    const began = performance.now();
    this.onFrame.emit();
    const spent = performance.now() - began;
    this.renderer.render(this.scene, this.camera);
    this.measured.frames += 1;
    this.measured.script += spent;
    this.measured.longest = Math.max(this.measured.longest, spent);
  }

  /** Turns the camera to a side, at a distance that shows everything. */
  look(view: keyof typeof VIEWS): void {
    const box = new Box3();
    this.content.updateMatrixWorld(true);
    for (const child of this.content.children) if (child.userData.fit) box.expandByObject(child);
    if (box.isEmpty()) box.set(new Vector3(-0.4, -0.4, 0), new Vector3(0.4, 0.4, 0.7));
    const centre = box.getCenter(new Vector3());
    // Room for the reach of one arm, around it or around all.
    const radius = Math.max(0.35, box.getSize(new Vector3()).length() / 2) * 0.8 + 0.16;
    const narrow = Math.min(1, this.camera.aspect / 1.4);
    const distance = radius / Math.sin(((FIELD_OF_VIEW / 2) * Math.PI) / 180) / Math.max(0.55, narrow);
    this.controls.target.copy(centre);
    this.camera.position.copy(VIEWS[view]).normalize().multiplyScalar(distance).add(centre);
    this.controls.update();
    this.invalidate();
  }

  /** The first look at the arms, once they are there. */
  fitOnce(): void {
    if (this.fitted) return;
    this.fitted = true;
    this.look('iso');
  }

  setGrid(visible: boolean): void {
    this.grid.visible = visible;
    this.invalidate();
  }

  private resize(): void {
    const {clientWidth, clientHeight} = this.element;
    if (!clientWidth || !clientHeight) return;
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.renderer.setSize(clientWidth, clientHeight);
    // A resized canvas is empty: not even one frame is left out.
    this.draw();
  }

  private recolour(): void {
    const dark = this.scheme.matches;
    this.scene.background = new Color(dark ? 0x14181d : 0xf1f3f5);
    this.grid.traverse((part) => dispose(part));
    this.grid.clear();
    const lines = new GridHelper(4, 40, dark ? 0x3d4650 : 0xb4bcc4, dark ? 0x232a31 : 0xdde2e6);
    lines.rotation.x = Math.PI / 2;
    lines.position.z = -0.001;
    const axes = new AxesHelper(0.25);
    this.grid.add(lines, axes);
    this.invalidate();
  }
}

/** Frees what an object keeps in the graphics processor. */
export function dispose(object: Object3D): void {
  const {geometry, material} = object as unknown as {geometry?: {dispose(): void}; material?: unknown};
  geometry?.dispose();
  for (const each of Array.isArray(material) ? material : material ? [material] : []) {
    (each as {dispose(): void}).dispose();
  }
}
