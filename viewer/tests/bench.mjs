// How soon an arm is seen: from the request for the page to the frame that has all of it, in a new browser context each
// time. Then four arms in motion: the page's own script of each frame, the processor time that serves the page, and the
// lateness of the tick with and without it. `DIMOS` is the program; software rendering, so a graphics processor is
// faster.
import {execFileSync, spawn} from 'node:child_process';
import {mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync} from 'node:fs';
import os from 'node:os';
import {join} from 'node:path';
import {environment, browser as launch, open, Run, text} from './rig.mjs';

const ROUNDS = Number(process.env.ROUNDS ?? 7);
/** Time in motion of each round [s]. */
const SECONDS = 10;
const ARMS = [
  ['primitives', 'yourarm-planner'],
  // A blueprint of robots with meshes, whose files are there.
  ...(process.env.MESHES ? [['meshes', process.env.MESHES]] : []),
];

const median = (values) => values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)];

/** Time [ms] of the first frame, and of the frame after which no geometry is added, since the request for the page. */
async function seen(browser, url) {
  const context = await browser.newContext({viewport: {width: 1200, height: 760}});
  const page = await context.newPage();
  await page.addInitScript(() => {
    window.seen = {first: 0, last: 0, geometries: 0};
    const look = () => {
      requestAnimationFrame(look);
      const {measured, memory} = window.dimos ?? {};
      if (!measured?.frames) return;
      window.seen.first ||= performance.now();
      if (memory.geometries === window.seen.geometries) return;
      [window.seen.geometries, window.seen.last] = [memory.geometries, performance.now()];
    };
    requestAnimationFrame(look);
  });
  await page.goto(url);
  await page.waitForFunction(() => window.seen.last && performance.now() - window.seen.last > 1500);
  const times = await page.evaluate(() => window.seen);
  await context.close();
  return times;
}

/** A blueprint with four arms that move independently, as a file in a new folder. */
function fourArms() {
  const names = ['a', 'b', 'c', 'd'];
  const joints = [1, 2, 3, 4, 5, 6].map((number) => `joint${number}`);
  const file = join(mkdtempSync(join(os.tmpdir(), 'dimos-page-')), 'four.yaml');
  const blueprint = {
    name: 'four',
    hardware: names.map((name) => ({
      hardware_id: name,
      joints: {prefix: name, count: 6},
      adapter_type: 'yourarm',
      address: 'sim',
      auto_enable: true,
    })),
    tasks: names.map((name) => ({name: `traj_${name}`, type: 'trajectory', joint_names: {hardware: name}})),
    planner: {
      robots: names.map((name, i) => ({
        name,
        model_path: 'builtin:yourarm',
        base_pose: {xyz: [0, 1.5 * i - 2.25, 0]},
        end_effector_link: 'flange',
        joint_names: joints,
        joint_prefix: `${name}_`,
        coordinator_task_name: `traj_${name}`,
      })),
    },
  };
  writeFileSync(file, JSON.stringify(blueprint));
  return {file, names, end: () => rmSync(join(file, '..'), {recursive: true})};
}

/** Moves an arm back and forth until it is ended; `failed` gets what a motion says that does not arrive. */
function swing(run, arm, failed) {
  let ended = false;
  const next = (to) => {
    if (ended) return;
    const goal = [to, -0.3, 0.6, 0, 0.8, to].map(String);
    const child = spawn(process.env.DIMOS, ['move', arm, ...goal, '--direct'], {
      env: environment(run.home),
      cwd: run.home,
    });
    let errors = '';
    child.stderr.on('data', (data) => (errors += data));
    child.on('exit', (code) => (code ? ended || failed(errors) : next(-to)));
  };
  next(1);
  return () => (ended = true);
}

/** Processor time [s] of the threads of a process, by their number. */
function threads(pid) {
  const spent = (task) => {
    const fields = readFileSync(`/proc/${pid}/task/${task}/stat`, 'utf8').split(') ').at(-1).split(' ');
    return (Number(fields[11]) + Number(fields[12])) / 100;
  };
  const name = (task) => readFileSync(`/proc/${pid}/task/${task}/comm`, 'utf8').trim();
  return new Map(readdirSync(`/proc/${pid}/task`).map((task) => [task, {name: name(task), spent: spent(task)}]));
}

/** One round of four arms in motion, with or without a page. */
async function inMotion(browser, file, names, viewed) {
  const run = await Run.start(file);
  const trouble = [];
  const swings = names.map((arm) => swing(run, arm, (text) => trouble.push(text)));
  try {
    const before = threads(run.child.pid);
    let page;
    if (viewed) {
      // Small: drawn by software, a large view would take the processors from the run.
      page = await open(browser, run.url, {width: 400, height: 500});
      await text(page, '#age', /^live$/);
    }
    const wait = () => new Promise((resolve) => setTimeout(resolve, SECONDS * 1000));
    // It serves the descriptions first; what counts is the time after that.
    await new Promise((resolve) => setTimeout(resolve, 2000));
    const [from, began] = [threads(run.child.pid), performance.now()];
    const measured = () => page.evaluate(() => ({...window.dimos.measured}));
    const first = viewed && (await measured());
    await wait();
    const last = viewed && (await measured());
    const to = threads(run.child.pid);
    const took = (performance.now() - began) / 1000;
    if (trouble.length) throw new Error(`an arm did not arrive: ${trouble[0]}`);
    // The live view's thread, and those of the page's connections.
    const serves = ([task, {name}]) => from.has(task) && (name === 'view' || !before.has(task));
    const spent = [...to].filter(serves).reduce((sum, [task, {spent}]) => sum + spent - from.get(task).spent, 0);
    const ticks = run.json('status')[0].ticks;
    const frames = viewed ? last.frames - first.frames : 0;
    return {
      lateness: ticks.lateness_us.p99,
      server: (100 * spent) / took,
      script: frames ? (last.script - first.script) / frames : 0,
      frames: frames / took,
    };
  } finally {
    for (const end of swings) end();
    run.end();
  }
}

const browser = await launch();
const four = fourArms();
try {
  const program = execFileSync(process.env.DIMOS, ['--version'], {encoding: 'utf8'}).trim();
  console.log(`${os.cpus()[0].model}, ${os.cpus().length} processors; ${program}, Chromium ${browser.version()}`);
  for (const [what, blueprint] of ARMS) {
    const run = await Run.start(blueprint);
    try {
      const url = run.url;
      const all = [];
      for (let round = 0; round < ROUNDS; round++) all.push(await seen(browser, url));
      const [first, last] = ['first', 'last'].map((key) => all.map((times) => times[key]));
      console.log(
        `${what} (${blueprint}): first frame ${median(first).toFixed(0)} ms, all ${all[0].geometries} geometries ` +
          `${median(last).toFixed(0)} ms (worst ${Math.max(...last).toFixed(0)} ms), ${ROUNDS} times` +
          (what === 'primitives' ? ' (goal 2000 ms)' : ''),
      );
    } finally {
      run.end();
    }
  }
  const [viewed, alone] = [[], []];
  for (let round = 0; round < ROUNDS; round++) {
    viewed.push(await inMotion(browser, four.file, four.names, true));
    alone.push(await inMotion(browser, four.file, four.names, false));
  }
  const of = (key, rounds = viewed) => median(rounds.map((round) => round[key]));
  const ratio = median(viewed.map(({lateness}, i) => lateness / alone[i].lateness));
  console.log(
    `four arms in motion, ${ROUNDS} rounds of ${SECONDS} s: ${of('frames').toFixed(0)} frames/s, script ` +
      `${of('script').toFixed(2)} ms a frame (goal 4 ms), server ${of('server').toFixed(1)} % of a core (goal 2 %)`,
  );
  console.log(
    `lateness of the tick, p99: ${of('lateness').toFixed(0)} µs with a page, ${of('lateness', alone).toFixed(0)} µs ` +
      `without; ratio ${ratio.toFixed(2)}, median of ${ROUNDS} pairs`,
  );
} finally {
  four.end();
  await browser.close();
}
