// What the tests of the page share: a run of the given program in folders of its own, and a real browser.
import {spawn, spawnSync} from 'node:child_process';
import {mkdirSync, mkdtempSync, readFileSync, rmSync} from 'node:fs';
import {connect} from 'node:net';
import {tmpdir} from 'node:os';
import {join} from 'node:path';
import {chromium} from 'playwright-core';

const PROGRAM = process.env.DIMOS;
const BROWSER = '/usr/bin/chromium';
/** Software rendering: test machines have no graphics processor. */
const FLAGS = [
  '--headless=new',
  '--no-sandbox',
  '--use-gl=angle',
  '--use-angle=swiftshader',
  '--enable-unsafe-swiftshader',
];
export const TIMEOUT = 20_000; // ms, of every wait

/** A run, in its own home folder. */
export class Run {
  constructor(home, child) {
    this.home = home;
    this.child = child;
  }

  static async start(...args) {
    const home = mkdtempSync(join(tmpdir(), 'dimos-page-'));
    for (const folder of ['run', 'state', 'config', 'cache']) mkdirSync(join(home, folder), {mode: 0o700});
    const record = args.includes('--record') ? [] : ['--no-record'];
    const child = spawn(PROGRAM, ['run', ...args, ...record], {
      env: environment(home),
      cwd: home,
      stdio: ['ignore', 'pipe', 'pipe'],
    });
    let output = '';
    const up = new Promise((resolve, reject) => {
      const take = (data) => {
        output += data;
        if (output.includes('Press Ctrl-C')) resolve();
      };
      child.stdout.on('data', take);
      child.stderr.on('data', take);
      child.on('exit', (code) => reject(new Error(`the run ended with ${code}:\n${output}`)));
      setTimeout(() => reject(new Error(`the run is not up:\n${output}`)), TIMEOUT).unref();
    });
    const run = new Run(home, child);
    await up.catch((error) => {
      run.end();
      throw error;
    });
    return run;
  }

  /** A verb of the program, to its end; what it printed. */
  dimos(...args) {
    const {status, stdout, stderr} = spawnSync(PROGRAM, args, {
      env: environment(this.home),
      cwd: this.home,
      encoding: 'utf8',
    });
    if (status !== 0) throw new Error(`dimos ${args.join(' ')}: ${status}\n${stdout}${stderr}`);
    return stdout;
  }

  json(...args) {
    return JSON.parse(this.dimos(...args, '--json'));
  }

  /** URL of the page, with the token. */
  get url() {
    return this.json('view').url;
  }

  arm(name) {
    return this.json('status')[0].arms.find((arm) => !name || arm.hardware_id === name);
  }

  positions(name) {
    const arm = this.json('state').arms.find((arm) => !name || arm.hardware_id === name);
    return arm.joints.map((joint) => joint.position);
  }

  /** A client beside the page, which gets the joint states of every tick: see `Watch`. */
  async watch() {
    const watch = new Watch(join(this.home, 'run/dimos', `${this.json('status')[0].run}.sock`));
    await watch.ready;
    return watch;
  }

  /** Ends the run, also one that is stopped by a signal, and removes its folders. */
  end() {
    this.child.removeAllListeners('exit');
    this.child.kill('SIGKILL');
    rmSync(this.home, {recursive: true, force: true});
  }
}

/** Joint states as the run publishes them, with the time of their ticks. */
export class Watch {
  positions = {};
  velocities = {};
  /** Of the newest tick [s since 1970]. */
  stamp = 0;

  constructor(path) {
    this.socket = connect(path);
    let rest = '';
    this.ready = new Promise((resolve, reject) => {
      this.socket.on('error', reject);
      this.socket.on('data', (data) => {
        const lines = (rest + data).split('\n');
        rest = lines.pop();
        for (const line of lines) if (this.take(JSON.parse(line))) resolve();
      });
    });
    this.send('subscribe', {stream: 'coordinator_joint_state'});
  }

  send(method, params) {
    this.socket.write(`${JSON.stringify({id: 1, method, params})}\n`);
  }

  take({stream, data}) {
    if (!stream) return false;
    data.name.forEach((name, i) => {
      this.positions[name] = data.position[i];
      this.velocities[name] = data.velocity[i];
    });
    this.stamp = data.stamp;
    return true;
  }

  /** Waits until a joint moves. */
  moving(joint) {
    return until(`${joint} moves`, () => Math.abs(this.velocities[joint]) > 0.01);
  }

  /** Waits until a joint has been at rest for 0.3 s; returns when that began [s since 1970]. */
  async resting(joint) {
    let since = 0;
    await until(
      `${joint} is at rest`,
      () => {
        if (Math.abs(this.velocities[joint]) > 1e-3) since = 0;
        else since ||= this.stamp;
        return since && this.stamp - since > 0.3;
      },
      5,
    );
    return since;
  }

  close() {
    this.socket.destroy();
  }
}

export function environment(home) {
  return {
    PATH: process.env.PATH,
    HOME: home,
    XDG_RUNTIME_DIR: join(home, 'run'),
    DIMOS_WORLD: join(home, 'run'),
    XDG_STATE_HOME: join(home, 'state'),
    XDG_CONFIG_HOME: join(home, 'config'),
    XDG_CACHE_HOME: join(home, 'cache'),
  };
}

export function browser() {
  // A page that the test serves counts as one of another network.
  const own = process.env.DIMOS_PAGE ? ['--disable-features=LocalNetworkAccessChecks'] : [];
  return chromium.launch({executablePath: BROWSER, args: [...FLAGS, ...own]});
}

/** A page that notes its requests and errors, and waits at most `TIMEOUT`. */
export async function open(browser, url, viewport = {width: 1200, height: 760}) {
  const context = await browser.newContext({viewport});
  const page = await context.newPage();
  page.setDefaultTimeout(TIMEOUT);
  page.requests = [];
  page.errors = [];
  page.on('request', (request) => page.requests.push(request.url()));
  page.on('websocket', (socket) => page.requests.push(socket.url()));
  page.on('pageerror', (error) => page.errors.push(error.stack));
  page.on('console', (message) => message.type() === 'error' && page.errors.push(message.text()));
  // The page that was built just now, in a program that does not embed it yet.
  if (process.env.DIMOS_PAGE) {
    await page.route(`${new URL(url).origin}/`, async (route) => {
      const response = await route.fetch();
      await route.fulfill({response, body: readFileSync(process.env.DIMOS_PAGE, 'utf8')});
    });
  }
  await page.goto(url);
  return page;
}

/** Waits until an element's text matches. */
export async function text(page, selector, pattern) {
  await page.waitForFunction(
    ([selector, source]) => new RegExp(source).test(document.querySelector(selector)?.textContent ?? ''),
    [selector, pattern.source],
  );
  return page.textContent(selector);
}

/** Polls until a check holds. */
export async function until(what, check, period = 100) {
  const end = Date.now() + TIMEOUT;
  while (!(await check())) {
    if (Date.now() > end) throw new Error(`not within ${TIMEOUT / 1000} s: ${what}`);
    await new Promise((resolve) => setTimeout(resolve, period));
  }
}

/** The 3D view as a picture. */
export function picture(page) {
  return page.locator('#view').screenshot();
}

/** Fraction of the pixels that differ between two pictures. */
export async function changed(browser, a, b) {
  const page = await browser.newPage();
  const fraction = await page.evaluate(
    async (urls) => {
      const [a, b] = await Promise.all(
        urls.map(async (url) => {
          const image = new Image();
          image.src = url;
          await image.decode();
          const context = Object.assign(document.createElement('canvas'), {
            width: image.width,
            height: image.height,
          }).getContext('2d');
          context.drawImage(image, 0, 0);
          return context.getImageData(0, 0, image.width, image.height).data;
        }),
      );
      let different = 0;
      for (let i = 0; i < a.length; i += 4) {
        different += Math.abs(a[i] - b[i]) + Math.abs(a[i + 1] - b[i + 1]) + Math.abs(a[i + 2] - b[i + 2]) > 48 ? 1 : 0;
      }
      return different / (a.length / 4);
    },
    [a, b].map((png) => `data:image/png;base64,${png.toString('base64')}`),
  );
  await page.close();
  return fraction;
}
