// The strip below the bar: what keeps each arm from moving or slows it, and who commands it. On every screen and tab.
import type {Context} from '../context';
import {el} from '../dom';
import type {ArmStatus, Status} from '../protocol';

/** A line of the strip: what it is about, what is so, and how much that matters. */
interface Line {
  level: 'bad' | 'warn' | 'info' | 'good' | 'muted';
  text: string;
}

export function strip(context: Context): HTMLElement {
  const element = el('div', {class: 'strip', id: 'strip', attributes: {role: 'status', 'aria-live': 'polite'}});
  let shown = '';
  context.run.onStatus.on((status) => {
    const lines = [...ofRun(status), ...status.arms.map(ofArm)];
    const key = JSON.stringify(lines);
    if (key === shown) return;
    shown = key;
    element.replaceChildren(...lines.map(({level, text}) => el('span', {class: `state ${level}`, text, title: text})));
  });
  return element;
}

function ofRun({speed}: Status): Line[] {
  if (speed.paused) return [{level: 'warn', text: 'paused'}];
  const percent = Math.round(speed.fraction * 100);
  return percent < 100 ? [{level: 'warn', text: `speed ${percent} %`}] : [];
}

const LEVELS: Record<string, Line['level']> = {
  ready: 'good',
  led: 'info',
  held: 'bad',
  activating: 'warn',
  standby: 'warn',
};

/** One line an arm, so that two arms fit a phone; its card has the rest. */
function ofArm(arm: ArmStatus): Line {
  const parts = [`${arm.hardware_id} ${arm.link === 'up' ? arm.phase : arm.link}`];
  let level = arm.link === 'up' ? (LEVELS[arm.phase] ?? 'muted') : 'bad';
  if (arm.cause) parts[0] += `: ${arm.cause.text}`;
  else if (arm.phase === 'led') parts[0] = ledText(arm);
  if (arm.error) parts.push(`error ${arm.error.code}`);
  if (arm.stop_pending) parts.push('a stop could not be sent');
  if (arm.stop_pending || arm.error) level = 'bad';
  const speed = arm.speed_fraction ?? 1;
  if (speed < 0.9995) {
    parts.push(`slowed by its controller to ${Math.round(100 * speed)} %`);
    if (level === 'good') level = 'warn';
  }
  if (arm.commander) parts.push(`commanded by ${arm.commander.program}`);
  return {level, text: parts.join(' · ')};
}

function ledText({hardware_id: name, led_by, enabled}: ArmStatus): string {
  if (led_by === 'controller') return `${name} is moved by its own controller`;
  return `${name} is led by hand, ${enabled ? 'motors on' : 'motors off: support the arm'}`;
}
