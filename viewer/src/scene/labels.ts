// Names of the arms in the view, where there are several: a click selects one.
import {type Object3D, Vector3} from 'three';
import {el} from '../dom';
import type {Stage} from './stage';

export class Labels {
  private readonly labels: {element: HTMLElement; object: Object3D; name: string}[] = [];
  private readonly point = new Vector3();

  constructor(
    private readonly stage: Stage,
    private readonly select: (name: string) => void,
  ) {
    stage.onFrame.on(() => this.place());
  }

  add(name: string, object: Object3D): void {
    const element = el('button', {
      class: 'arm-label',
      text: name,
      onclick: () => this.select(name),
      attributes: {type: 'button'},
    });
    this.stage.element.append(element);
    this.labels.push({element, object, name});
  }

  choose(name: string): void {
    for (const label of this.labels) label.element.setAttribute('aria-pressed', String(label.name === name));
  }

  /** Each name below the base of its arm. */
  private place(): void {
    const {clientWidth: width, clientHeight: height} = this.stage.element;
    for (const {element, object} of this.labels) {
      object.getWorldPosition(this.point).project(this.stage.camera);
      element.hidden = this.point.z > 1;
      const [x, y] = [((this.point.x + 1) / 2) * width, ((1 - this.point.y) / 2) * height];
      element.style.transform = `translate(${x.toFixed(0)}px, ${y.toFixed(0)}px) translate(-50%, 12px)`;
    }
  }
}
