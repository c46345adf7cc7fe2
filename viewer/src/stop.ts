// Stop: holds all arms of the run. It says what the run confirmed, and for each arm when it was held.
import {RpcError, type StopReply} from './protocol';
import type {Run} from './run';
import {Signal} from './signal';
import {clock} from './units';

const TIMEOUT = 5000; // ms; the run itself waits 3 s for its arms

export class Stop {
  /** One line per arm, or why nothing was sent. */
  lines: {text: string; good: boolean}[] = [];
  active = false;
  sending = false;
  readonly changed = new Signal();

  constructor(private readonly run: Run) {
    run.onStatus.on(() => {
      // The report stays until every arm that it names was reset.
      if (this.active && !this.sending && !run.status!.arms.some((arm) => arm.phase === 'held' || arm.stop_pending)) {
        this.active = false;
        this.lines = [];
        this.changed.emit();
      }
    });
  }

  async press(): Promise<void> {
    this.active = this.sending = true;
    this.lines = [{text: 'stop sent…', good: false}];
    this.changed.emit();
    const began = performance.now();
    try {
      // Whichever connection is there; `watch` waits for nothing else.
      const connection = this.run.watch.state === 'open' ? this.run.watch : this.run.work;
      const {arms} = await connection.request<StopReply>('stop', {}, TIMEOUT);
      const after = Math.round(performance.now() - began);
      this.lines = Object.entries(arms).map(([arm, confirmation]) => ({
        good: confirmation === 'confirmed',
        text:
          confirmation === 'confirmed'
            ? `${arm} held at ${clock(new Date())} (${after} ms)`
            : confirmation === 'not_sent'
              ? `${arm} NOT STOPPED: unreachable; the stop is delivered when it is back`
              : `${arm}: stop sent, NOT CONFIRMED by the arm`,
      }));
    } catch (error) {
      const why = error instanceof RpcError ? error.message : String(error);
      this.lines = [{good: false, text: `NOT CONFIRMED: ${why}. Use the stop button at the arm`}];
    }
    this.sending = false;
    this.changed.emit();
  }
}
