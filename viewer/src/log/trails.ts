// The measured ways of tool centre points, as lines.
import {BufferAttribute, BufferGeometry, Line, LineBasicMaterial} from 'three';
import type {Vec3} from '../protocol';
import type {Stage} from '../scene/stage';

const POINTS = 2000;

export class Trails {
  /** Which plans are shown beside them. */
  key = '';
  private readonly lines: Line[] = [];
  private visible = true;

  constructor(private readonly stage: Stage) {}

  draw(ways: Vec3[][]): void {
    ways.forEach((way, i) => {
      this.lines[i] ??= this.add();
      const line = this.lines[i];
      const attribute = line.geometry.getAttribute('position') as BufferAttribute;
      const points = way.slice(-POINTS);
      for (const [k, point] of points.entries()) attribute.setXYZ(k, ...point);
      attribute.needsUpdate = true;
      line.geometry.setDrawRange(0, points.length);
    });
    for (const line of this.lines.slice(ways.length)) line.geometry.setDrawRange(0, 0);
  }

  show(visible: boolean): void {
    this.visible = visible;
    for (const line of this.lines) line.visible = visible;
    this.stage.invalidate();
  }

  private add(): Line {
    const points = new BufferAttribute(new Float32Array(POINTS * 3), 3);
    const geometry = new BufferGeometry().setAttribute('position', points);
    const line = new Line(geometry, new LineBasicMaterial({color: 0xe5484d}));
    line.frustumCulled = false;
    line.visible = this.visible;
    this.stage.scene.add(line);
    return line;
  }
}
