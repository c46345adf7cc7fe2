// Figures as text: SI, and degrees where people chose them.
import {Signal} from './signal';

export type AngleUnit = 'rad' | 'deg';
const KEY = 'dimos.angle';

/** The unit of angles on this page, kept by the browser. */
export const angle = {
  unit: ((): AngleUnit => {
    try {
      return localStorage.getItem(KEY) === 'deg' ? 'deg' : 'rad';
    } catch {
      return 'rad';
    }
  })(),
  changed: new Signal(),
  set(unit: AngleUnit) {
    this.unit = unit;
    try {
      localStorage.setItem(KEY, unit);
    } catch {
      /* the browser keeps nothing: the choice is that of this visit */
    }
    this.changed.emit();
  },
  get factor(): number {
    return this.unit === 'deg' ? 180 / Math.PI : 1;
  },
  /** Unit on screen. */
  get label(): string {
    return this.unit === 'deg' ? '°' : 'rad';
  },
};

/** A figure with a fixed number of decimals; a dash if it is unknown. Never "-0.000". */
export function figure(value: number | null | undefined, decimals: number): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  const text = value.toFixed(decimals);
  return /^-0(\.0*)?$/.test(text) ? text.slice(1) : text.replace('-', '−');
}

export function angleText(value: number | null | undefined): string {
  return figure(value === null || value === undefined ? null : value * angle.factor, angle.unit === 'deg' ? 1 : 3);
}

/** A duration: `1.2 s`, `340 ms`, `3 min 20 s`. */
export function duration(milliseconds: number): string {
  if (milliseconds < 1000) return `${Math.round(milliseconds)} ms`;
  const seconds = milliseconds / 1000;
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  return `${Math.floor(seconds / 60)} min ${Math.floor(seconds % 60)} s`;
}

/** Time of day with milliseconds. */
export function clock(date: Date): string {
  const two = (n: number) => String(n).padStart(2, '0');
  return (
    `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}.` +
    String(date.getMilliseconds()).padStart(3, '0')
  );
}

/** The joint's name without the arm's: `joint1` of `left_joint1`. */
export function shortJoint(joint: string, arm: string): string {
  return joint.startsWith(`${arm}_`) && joint.length > arm.length + 1 ? joint.slice(arm.length + 1) : joint;
}
