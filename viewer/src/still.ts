// A log or a model in the form of a run: the panels that show a run also show a log, or a model at joint positions.

import type {Scene} from './protocol';
import {Run} from './run';

export class Still extends Run {
  constructor(scene: Scene) {
    super(scene, '', '');
  }

  override start(): void {}

  override get connected(): boolean {
    return true;
  }

  override get age(): number {
    return 0;
  }

  override armAge(): number {
    return 0;
  }
}
