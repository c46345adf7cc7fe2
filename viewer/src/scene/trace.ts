// Lines in the view: the way that a tool centre point came, and the way of a plan.
import {BufferAttribute, BufferGeometry, Line, LineBasicMaterial, Vector3} from 'three';
import type {Vec3} from '../protocol';

const POINTS = 900;
const SHORTEST = 0.001; // m between two points

/** The last way of a point, in a buffer of fixed size. */
export class Trace {
  readonly line: Line;
  private readonly points = new Float32Array(POINTS * 3);
  private readonly attribute = new BufferAttribute(this.points, 3);
  private count = 0;
  private readonly last = new Vector3(Infinity, 0, 0);

  constructor(color: number) {
    const geometry = new BufferGeometry().setAttribute('position', this.attribute);
    geometry.setDrawRange(0, 0);
    this.line = new Line(geometry, new LineBasicMaterial({color}));
    this.line.frustumCulled = false;
  }

  /** Adds a point if it is away from the last one. */
  add(point: Vector3): void {
    if (this.last.distanceTo(point) < SHORTEST) return;
    this.last.copy(point);
    if (this.count === POINTS) {
      // A third at once, so that the buffer is seldom moved.
      this.points.copyWithin(0, POINTS);
      this.count = POINTS - POINTS / 3;
    }
    point.toArray(this.points, this.count * 3);
    this.count += 1;
    this.attribute.needsUpdate = true;
    this.line.geometry.setDrawRange(0, this.count);
  }

  clear(): void {
    this.count = 0;
    this.last.set(Infinity, 0, 0);
    this.line.geometry.setDrawRange(0, 0);
  }
}

/** The way of a planned motion. */
export function planLine(points: Vec3[]): Line {
  const geometry = new BufferGeometry().setFromPoints(points.map((point) => new Vector3(...point)));
  return new Line(geometry, new LineBasicMaterial({color: 0x3b9eff}));
}
