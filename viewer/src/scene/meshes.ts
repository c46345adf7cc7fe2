// Meshes of the run, each fetched once, and shared by an arm and its ghosts.
import {BufferGeometry} from 'three';
import {STLLoader} from 'three/addons/loaders/STLLoader.js';

const AT_ONCE = 4;

export class Meshes {
  private readonly geometries = new Map<string, Promise<BufferGeometry>>();
  private readonly waiting: (() => void)[] = [];
  private active = 0;

  constructor(private readonly token: string) {}

  get(url: string): Promise<BufferGeometry> {
    let geometry = this.geometries.get(url);
    if (!geometry) {
      geometry = this.fetch(url);
      this.geometries.set(url, geometry);
    }
    return geometry;
  }

  private async fetch(url: string): Promise<BufferGeometry> {
    if (this.active >= AT_ONCE) await new Promise<void>((go) => this.waiting.push(go));
    this.active += 1;
    try {
      const reply = await fetch(url, {headers: {Authorization: `Bearer ${this.token}`}});
      if (!reply.ok) throw new Error(`${url}: ${reply.status} ${await reply.text()}`);
      const geometry = new STLLoader().parse(await reply.arrayBuffer());
      geometry.computeVertexNormals();
      return geometry;
    } finally {
      this.active -= 1;
      this.waiting.shift()?.();
    }
  }
}
