// One WebSocket to the run: requests with replies, messages of subscriptions, and reconnection with back-off.
import {RpcError} from './protocol';

const FIRST_DELAY = 250; // ms before the first retry; doubled for each further one
const LONGEST_DELAY = 4000;
const CONNECT_TIMEOUT = 4000;
const WRONG_TOKEN = 4401;
const TOO_MANY_PAGES = 4429;

interface Pending {
  resolve(result: unknown): void;
  reject(error: RpcError): void;
  timer: number;
}

export type LinkState = 'connecting' | 'open' | 'lost' | 'refused';

export class Connection {
  state: LinkState = 'connecting';
  /** When the next attempt begins [ms, `performance.now`]; 0 while there is none. */
  retryAt = 0;
  attempts = 0;
  /** The server has as many pages as it serves. */
  full = false;
  onState: () => void = () => {};
  onStream: (stream: string, data: unknown, lost: number, past: boolean) => void = () => {};

  private socket: WebSocket | null = null;
  private pending = new Map<number, Pending>();
  private next = 1;

  constructor(
    private readonly url: string,
    private readonly token: string,
  ) {}

  open(): void {
    this.retryAt = 0;
    const socket = new WebSocket(this.url);
    this.socket = socket;
    const timer = window.setTimeout(() => socket.close(), CONNECT_TIMEOUT);
    socket.onopen = () => socket.send(JSON.stringify({token: this.token}));
    socket.onmessage = (event) => {
      const message = JSON.parse(event.data as string) as Record<string, unknown>;
      if (this.state === 'open') {
        this.take(message);
      } else if (message.ok === true) {
        clearTimeout(timer);
        this.attempts = 0;
        this.change('open');
      }
    };
    socket.onclose = (event) => {
      clearTimeout(timer);
      if (this.socket !== socket) return;
      this.socket = null;
      this.failAll();
      if (event.code === WRONG_TOKEN) return this.change('refused');
      this.full = event.code === TOO_MANY_PAGES;
      const delay = this.full ? LONGEST_DELAY : Math.min(FIRST_DELAY * 2 ** this.attempts, LONGEST_DELAY);
      this.attempts += 1;
      this.retryAt = performance.now() + delay;
      this.change('lost');
      window.setTimeout(() => this.open(), delay);
    };
  }

  /** Gives a connection up that no longer answers; the next attempt follows. */
  drop(): void {
    const socket = this.socket;
    if (!socket) return;
    socket.close();
    // A peer that does not answer the closing handshake would keep the socket for a long time.
    socket.onclose?.(new CloseEvent('close', {code: 1006}));
  }

  /** Sends a request. Rejects with the run's error, or with `LOST` if there is no reply. */
  request<T>(method: string, params: object = {}, timeout = 15_000): Promise<T> {
    return new Promise((resolve, reject) => {
      if (this.state !== 'open' || !this.socket) {
        reject(new RpcError('LOST', `no connection to the run: ${method} was not sent`));
        return;
      }
      const id = this.next++;
      const timer = window.setTimeout(() => {
        this.pending.delete(id);
        reject(new RpcError('LOST', `no reply to ${method} for ${timeout / 1000} s`, 'it may still take effect'));
      }, timeout);
      this.pending.set(id, {resolve: resolve as (result: unknown) => void, reject, timer});
      this.socket.send(JSON.stringify({id, method, params}));
    });
  }

  private take(message: Record<string, unknown>): void {
    if (typeof message.stream === 'string') {
      this.onStream(message.stream, message.data, (message.lost as number | undefined) ?? 0, message.past === true);
      return;
    }
    const pending = this.pending.get(message.id as number);
    if (!pending) return;
    this.pending.delete(message.id as number);
    clearTimeout(pending.timer);
    const error = message.error as {code: string; message: string; hint?: string} | undefined;
    if (error) pending.reject(new RpcError(error.code, error.message, error.hint));
    else pending.resolve(message.result);
  }

  private failAll(): void {
    for (const {reject, timer} of this.pending.values()) {
      clearTimeout(timer);
      reject(new RpcError('LOST', 'the connection was lost before the reply', 'the request may have taken effect'));
    }
    this.pending.clear();
  }

  private change(state: LinkState): void {
    this.state = state;
    this.onState();
  }
}
