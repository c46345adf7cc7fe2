// Obstacles of the world, and objects that arms hold.
import {
  BoxGeometry,
  type BufferGeometry,
  CylinderGeometry,
  EdgesGeometry,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  type Object3D,
  OctahedronGeometry,
  Points,
  PointsMaterial,
  Quaternion,
  SphereGeometry,
} from 'three';
import type {Pose, Shape, WorldObject} from '../protocol';
import type {Meshes} from './meshes';
import {quaternionOf} from './robot';
import {dispose} from './stage';

const FREE = 0x8fa3b8;
const HELD = 0x4fb286;

export class Obstacles {
  private readonly objects = new Map<string, {key: string; object: Object3D}>();
  /** The object that is being moved by hand keeps its place on screen. */
  held: string | null = null;

  constructor(
    private readonly root: Object3D,
    private readonly link: (robot: string, link: string) => Object3D | null,
    private readonly changed: () => void,
    private readonly meshes: Meshes,
  ) {}

  /** Shows this world: only what differs is made again. */
  show(world: WorldObject[]): void {
    const seen = new Set<string>();
    for (const object of world) {
      seen.add(object.name);
      const key = JSON.stringify(object);
      const before = this.objects.get(object.name);
      if (before?.key === key || (before && this.held === object.name)) continue;
      if (before) this.remove(object.name);
      this.add(object, key);
    }
    for (const name of [...this.objects.keys()]) if (!seen.has(name)) this.remove(name);
  }

  get(name: string): Object3D | undefined {
    return this.objects.get(name)?.object;
  }

  private add(object: WorldObject, key: string): void {
    const held = object.held_by;
    const geometry = geometryOf(object.shape);
    const mesh = new Mesh(
      geometry,
      new MeshLambertMaterial({
        color: held ? HELD : FREE,
        transparent: true,
        opacity: held ? 0.9 : 0.35,
      }),
    );
    const edges = new LineSegments(new EdgesGeometry(geometry, 30), new LineBasicMaterial({color: held ? HELD : FREE}));
    mesh.add(edges);
    void this.dress(mesh, edges, object);
    mesh.userData.attached = true;
    place(mesh, object.pose);
    const parent = held ? this.link(held[0], held[1]) : this.root;
    (parent ?? this.root).add(mesh);
    this.objects.set(object.name, {key, object: mesh});
    this.changed();
  }

  /** Gives an object its mesh or its points, when they are there. */
  private async dress(mesh: Mesh, edges: LineSegments, {name, shape}: WorldObject): Promise<void> {
    const file = 'mesh' in shape ? shape.mesh : 'cloud' in shape ? shape.cloud : '';
    if (!file) return;
    // The file is part of the address: an object of the same name may come to have another one.
    const url = `/object/${encodeURIComponent(name)}?${encodeURIComponent(file)}`;
    try {
      if ('cloud' in shape) {
        const points = new Points(await this.meshes.cloud(url), new PointsMaterial({color: FREE, size: 0.008}));
        mesh.add(points);
        (mesh.material as MeshLambertMaterial).visible = edges.visible = false;
      } else {
        const geometry = await this.meshes.get(url);
        mesh.geometry.dispose();
        edges.geometry.dispose();
        // Disposed with the object, so it has its own.
        mesh.geometry = geometry.clone();
        edges.geometry = new EdgesGeometry(geometry, 30);
      }
      this.changed();
    } catch (error) {
      console.warn(error);
    }
  }

  private remove(name: string): void {
    const {object} = this.objects.get(name)!;
    object.removeFromParent();
    object.traverse((part) => dispose(part));
    this.objects.delete(name);
    this.changed();
  }
}

/** Poses an object like a pose of the run. */
export function place(object: Object3D, pose: Pose): void {
  object.position.set(...pose.xyz);
  object.quaternion.copy(pose.quat ? new Quaternion(...pose.quat).normalize() : quaternionOf(pose.rpy ?? [0, 0, 0]));
}

/** Until the file of a mesh or a cloud is here, a small marker shows where it is. */
function geometryOf(shape: Shape): BufferGeometry {
  if ('box' in shape) return new BoxGeometry(...shape.box);
  if ('sphere' in shape) return new SphereGeometry(shape.sphere, 32, 20);
  if ('cylinder' in shape) {
    const [radius, length] = shape.cylinder;
    return new CylinderGeometry(radius, radius, length, 36).rotateX(Math.PI / 2);
  }
  return new OctahedronGeometry(0.03);
}
