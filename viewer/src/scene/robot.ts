// One arm of the view: its links from the URDF, its joints, collision geometry, ghosts and tool centre point.
import {
  AxesHelper,
  Color,
  DoubleSide,
  Group,
  type Material,
  Matrix4,
  Mesh,
  MeshLambertMaterial,
  MeshPhongMaterial,
  Object3D,
  Quaternion,
  Vector3,
} from 'three';
import URDFLoader, {type URDFRobot} from 'urdf-loader';
import type {ArmStatus, SceneRobot} from '../protocol';
import type {Meshes} from './meshes';
import {dispose} from './stage';

type Kind = 'goal' | 'plan';
const GHOSTS: Record<Kind, number> = {goal: 0xf5a524, plan: 0x3b9eff};
/** A goal that cannot be reached, or where something touches. */
const BAD = 0xe5484d;

export class Robot {
  readonly group = new Group();
  private readonly urdf: URDFRobot;
  private readonly ghosts = new Map<Kind, URDFRobot>();
  private readonly frames: AxesHelper[] = [];
  private readonly tool = new Matrix4();
  private readonly tcpFrame = frame(0.09);
  private colliders = false;
  private stale = false;
  /** Materials whose colours are right. */
  private readonly toned = new WeakSet<Material>([touchingMaterial]);
  /** Materials of links that were drawn red. */
  private readonly own = new WeakMap<Mesh, Material | Material[]>();

  constructor(
    readonly model: SceneRobot,
    meshes: Meshes,
    private readonly changed: () => void,
  ) {
    const loader = new URDFLoader();
    loader.parseCollision = true;
    loader.loadMeshCb = (url, _manager, material, done) => {
      void meshes.get(url).then(
        (geometry) => {
          done(new Mesh(geometry, material));
          this.dress();
        },
        (error: Error) => {
          console.warn(error);
          done(new Object3D());
        },
      );
    };
    this.urdf = loader.parse(withMaterials(model.urdf));
    for (const joint of Object.values(this.urdf.joints)) joint.ignoreLimits = true;
    for (const [name, value] of Object.entries(model.fixed ?? {})) this.urdf.setJointValue(name, value);
    this.group.position.set(...model.base.xyz);
    this.group.quaternion.set(...model.base.quat);
    this.group.userData.fit = true;
    this.group.add(this.urdf);
    this.tcpFrame.matrixAutoUpdate = false;
    if (model.tip) this.link.add(this.tcpFrame);
    this.dress();
  }

  /** Sets joints by the coordinator's names; true if the arm looks different now. */
  setJoints(position: (joint: string) => number | null | undefined): boolean {
    let moved = false;
    for (const [joint, name] of this.moving()) {
      const value = position(joint);
      if (value !== null && value !== undefined) moved = this.urdf.setJointValue(name, value) || moved;
    }
    return moved;
  }

  /** Sets a joint of the model by its own name: a finger. */
  setFinger(name: string, value: number): boolean {
    return name in this.urdf.joints && this.urdf.setJointValue(name, value);
  }

  setTool(tcp: ArmStatus['tcp']): void {
    const tool = tcp?.tool;
    const turn = tool ? quaternionOf(tool.rpy) : new Quaternion();
    this.tool.compose(new Vector3(...(tool?.xyz ?? [0, 0, 0])), turn, new Vector3(1, 1, 1));
    this.tcpFrame.matrix.copy(this.tool);
  }

  /** Draws the arm faintly while its state is old. */
  setStale(stale: boolean): void {
    if (stale === this.stale) return;
    this.stale = stale;
    this.urdf.traverse((part) => {
      if (!(part as {isURDFVisual?: boolean}).isURDFVisual) return;
      part.traverse((mesh) => {
        if (!(mesh instanceof Mesh)) return;
        const material = mesh.material as Material;
        material.userData.opacity ??= material.opacity;
        material.transparent = stale || (material.userData.opacity as number) < 1;
        material.opacity = (material.userData.opacity as number) * (stale ? 0.3 : 1);
        material.needsUpdate = true;
      });
    });
    this.changed();
  }

  /** Pose of the tool centre point in `map`. */
  tcp(position: Vector3, quaternion: Quaternion): void {
    this.link.updateWorldMatrix(true, false);
    new Matrix4().multiplyMatrices(this.link.matrixWorld, this.tool).decompose(position, quaternion, new Vector3());
  }

  /** Where the first joint of an arm is. */
  baseOf(joint: string | undefined): Object3D {
    return this.urdf.joints[this.model.joints[joint ?? ''] ?? ''] ?? this.group;
  }

  /** Whether a joint, by the coordinator's name, is prismatic. */
  isLinear(joint: string): boolean {
    return this.urdf.joints[this.model.joints[joint] ?? '']?.jointType === 'prismatic';
  }

  /** Draws links red. */
  highlight(chosen: (link: string) => boolean): void {
    for (const [name, link] of Object.entries(this.urdf.links)) {
      const red = chosen(name);
      for (const visual of link.children) {
        if (!(visual as {isURDFVisual?: boolean}).isURDFVisual) continue;
        visual.traverse((mesh) => {
          if (!(mesh instanceof Mesh)) return;
          // Links may share a material of the description.
          const own = this.own.get(mesh) ?? mesh.material;
          this.own.set(mesh, own);
          mesh.material = red ? touchingMaterial : own;
        });
      }
    }
    this.changed();
  }

  linkNamed(name: string): Object3D {
    return this.urdf.links[name] ?? this.link;
  }

  /** Shows the arm at other joint positions beside itself, or removes that. Unknown joints are as measured. */
  setGhost(kind: Kind, position: ((joint: string) => number | null | undefined) | null, bad = false): void {
    let ghost = this.ghosts.get(kind);
    if (!position) {
      if (!ghost) return;
      this.group.remove(ghost);
      this.ghosts.delete(kind);
      ghost.traverse((part) => disposeMaterial(part));
      this.changed();
      return;
    }
    if (!ghost) {
      ghost = this.makeGhost(kind);
      this.ghosts.set(kind, ghost);
      this.group.add(ghost);
    }
    for (const [joint, name] of this.moving()) {
      const value = position(joint) ?? (this.urdf.joints[name]?.angle as number | undefined) ?? 0;
      ghost.setJointValue(name, value);
    }
    (ghost.userData.material as MeshLambertMaterial).color.set(bad ? BAD : GHOSTS[kind]);
    this.changed();
  }

  showColliders(visible: boolean): void {
    this.colliders = visible;
    this.dress();
  }

  /** Shows the frame of every link. */
  showFrames(visible: boolean): void {
    for (const axes of this.frames.splice(0)) {
      axes.removeFromParent();
      dispose(axes);
    }
    if (visible) {
      for (const link of Object.values(this.urdf.links)) {
        const axes = frame(0.06);
        link.add(axes);
        this.frames.push(axes);
      }
    }
    this.changed();
  }

  /** The joints that the run measures: the coordinator's names, and those of the URDF. */
  private moving(): [string, string][] {
    return [...Object.entries(this.model.joints), ...Object.entries(this.model.moved_by_others ?? {})];
  }

  private get link(): Object3D {
    return this.urdf.links[this.model.tip] ?? this.urdf;
  }

  /** Colours and visibility, also of meshes that came just now. */
  private dress(): void {
    this.urdf.traverse((part) => {
      const collider = (part as {isURDFCollider?: boolean}).isURDFCollider;
      const visual = (part as {isURDFVisual?: boolean}).isURDFVisual;
      if (collider) {
        part.visible = this.colliders;
        part.traverse((mesh) => {
          if (mesh instanceof Mesh) mesh.material = colliderMaterial;
        });
      } else if (visual) {
        part.traverse((mesh) => {
          const material: unknown = mesh instanceof Mesh && mesh.material;
          if (!(material instanceof MeshPhongMaterial) || this.toned.has(material)) return;
          this.toned.add(material);
          material.shininess = 25;
          // The loader takes the figures of a description for linear ones; people choose colours as on a screen.
          material.color.convertSRGBToLinear();
        });
      }
    });
    // A ghost that was made before its meshes came is made again when it is needed next.
    for (const kind of [...this.ghosts.keys()]) this.setGhost(kind, null);
    this.changed();
  }

  private makeGhost(kind: Kind): URDFRobot {
    const ghost = this.urdf.clone() as URDFRobot;
    const drop: Object3D[] = [];
    const material = new MeshLambertMaterial({
      color: new Color(GHOSTS[kind]),
      transparent: true,
      opacity: kind === 'goal' ? 0.4 : 0.45,
      depthWrite: false,
      // Where both are at the same place, the arm is seen.
      polygonOffset: true,
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 8,
    });
    ghost.traverse((part) => {
      if ((part as {isURDFCollider?: boolean}).isURDFCollider || part instanceof AxesHelper || part.userData.attached) {
        drop.push(part);
      }
      // A link that no joint moves would only tint the arm itself.
      if ((part as {isURDFVisual?: boolean}).isURDFVisual && !moves(part)) drop.push(part);
      if (part instanceof Mesh) part.material = material;
    });
    for (const part of drop) part.removeFromParent();
    for (const joint of Object.values(ghost.joints)) joint.ignoreLimits = true;
    ghost.renderOrder = 1;
    ghost.userData.material = material;
    return ghost;
  }
}

const colliderMaterial: Material = new MeshLambertMaterial({
  color: 0xff5d8f,
  transparent: true,
  opacity: 0.35,
  depthWrite: false,
  side: DoubleSide,
});

const touchingMaterial: Material = new MeshPhongMaterial({color: 0xe5484d});

/** Links may use a material that another link defines: the loader knows those of the robot only. */
function withMaterials(text: string): Document {
  const urdf = new DOMParser().parseFromString(text, 'text/xml');
  const known = new Set([...urdf.querySelectorAll('robot > material')].map((each) => each.getAttribute('name')));
  for (const material of urdf.querySelectorAll('visual > material[name]:has(color)')) {
    const name = material.getAttribute('name');
    if (!name || known.has(name)) continue;
    known.add(name);
    urdf.documentElement.append(material.cloneNode(true));
  }
  return urdf;
}

/** The axes of a frame, also seen through links. */
function frame(size: number): AxesHelper {
  const axes = new AxesHelper(size);
  (axes.material as Material).depthTest = false;
  axes.renderOrder = 2;
  return axes;
}

/** Whether a joint can move this part of a model. */
function moves(part: Object3D): boolean {
  for (let at: Object3D | null = part; at; at = at.parent) {
    const type = (at as {jointType?: string}).jointType;
    if (type && type !== 'fixed') return true;
  }
  return false;
}

/** Geometry of a ghost is the arm's own. */
function disposeMaterial(part: Object3D): void {
  if (part instanceof Mesh) (part.material as Material).dispose();
}

/** Roll, pitch, yaw about fixed axes. */
export function quaternionOf(rpy: readonly [number, number, number]): Quaternion {
  const [x, y, z] = [new Vector3(1, 0, 0), new Vector3(0, 1, 0), new Vector3(0, 0, 1)];
  return new Quaternion()
    .setFromAxisAngle(z, rpy[2])
    .multiply(new Quaternion().setFromAxisAngle(y, rpy[1]))
    .multiply(new Quaternion().setFromAxisAngle(x, rpy[0]));
}
