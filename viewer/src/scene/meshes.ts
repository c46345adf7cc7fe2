// Meshes and point clouds of the run, each fetched once, and shared by an arm and its ghosts.
import {BufferAttribute, BufferGeometry} from 'three';
import {STLLoader} from 'three/addons/loaders/STLLoader.js';

const AT_ONCE = 4;

export class Meshes {
  private readonly geometries = new Map<string, Promise<BufferGeometry>>();
  private readonly waiting: (() => void)[] = [];
  private active = 0;

  constructor(private readonly token: string) {}

  /** A mesh. */
  get(url: string): Promise<BufferGeometry> {
    return this.once(url, (data) => {
      const geometry = new STLLoader().parse(data);
      geometry.computeVertexNormals();
      return geometry;
    });
  }

  /** The points of a cloud. */
  cloud(url: string): Promise<BufferGeometry> {
    return this.once(url, (data) =>
      new BufferGeometry().setAttribute('position', new BufferAttribute(new Float32Array(data), 3)),
    );
  }

  private once(url: string, read: (data: ArrayBuffer) => BufferGeometry): Promise<BufferGeometry> {
    let geometry = this.geometries.get(url);
    if (!geometry) {
      geometry = this.fetch(url, read);
      this.geometries.set(url, geometry);
    }
    return geometry;
  }

  private async fetch(url: string, read: (data: ArrayBuffer) => BufferGeometry): Promise<BufferGeometry> {
    if (this.active >= AT_ONCE) await new Promise<void>((go) => this.waiting.push(go));
    this.active += 1;
    try {
      const reply = await fetch(url, {headers: {Authorization: `Bearer ${this.token}`}});
      if (!reply.ok) throw new Error(`${url}: ${reply.status} ${await reply.text()}`);
      return read(await reply.arrayBuffer());
    } finally {
      this.active -= 1;
      this.waiting.shift()?.();
    }
  }
}
