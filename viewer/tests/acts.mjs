// Acts of the page on a run with three arms, judged by what the emulated arms did: jog, goals of two arms, waypoints,
// inverse kinematics of a dragged pose, teach, and Stop by Space.
import assert from 'node:assert/strict';
import {after, before, test} from 'node:test';
import {browser as launch, open, Run, text, until} from './rig.mjs';

const HOME = [0, -0.3, 0.6, 0, 0.8, 0];
let browser, run, page, watch;

before(async () => {
  const blueprint = new URL('acts.yaml', import.meta.url).pathname;
  [browser, run] = await Promise.all([launch(), Run.start(blueprint)]);
  page = await open(browser, run.url);
  watch = await run.watch();
  await text(page, '#age', /^live$/);
});
after(async () => {
  watch?.close();
  run?.end();
  await browser?.close();
});

const near = (a, b, tolerance = 0.01) => a.every((value, i) => Math.abs(value - b[i]) < tolerance);
const joint1 = () => watch.positions.left_joint1;
const press = async (on, name) => {
  // Waits until the button neither moves nor is covered: the panel may still be laid out.
  await on.locator(`[data-jog="${name}"]`).hover();
  await on.mouse.down();
};

/** Holds a motion, ends the holding in some way, and checks that the arm rests soon after, and has let others in. */
async function jogs(joint, on, begin, end) {
  await begin();
  await watch.moving(joint);
  await end();
  const [released, at] = [Date.now() / 1000, watch.positions[joint]];
  const rest = await watch.resting(joint);
  const [took, way] = [rest - released, Math.abs(watch.positions[joint] - at)];
  // At 0.1 rad/s: an arm that goes on moving is farther away before a loaded computer is slow.
  assert.ok(took < 2 && way < 0.15, `${on}: at rest after ${took.toFixed(3)} s and ${way.toFixed(4)} rad`);
  await until(`${on}: the lease is released`, () => !run.arm('left').commander);
  return `${on} ${(1000 * took).toFixed(0)} ms`;
}

test('jog moves while a button or key is held, and never longer', async () => {
  await page.click('[data-tab=jog]');
  const measured = [];
  // The end effector along y moves joint 1.
  await page.waitForSelector('[data-jog="y+"]:enabled');
  measured.push(
    await jogs(
      'left_joint1',
      'tool',
      () => press(page, 'y+'),
      () => page.mouse.up(),
    ),
  );
  await page.click('[data-panel=jog] [data-value=joints]');
  await page.waitForSelector('[data-jog="joint1+"]:enabled');
  const start = joint1();
  measured.push(
    await jogs(
      'left_joint1',
      'button',
      () => press(page, 'joint1+'),
      () => page.mouse.up(),
    ),
  );
  assert.ok(joint1() > start + 0.005, `in the direction of the button: ${start} → ${joint1()}`);
  await page.click('#jog-keys');
  const down = () => page.keyboard.down('-');
  measured.push(await jogs('left_joint1', 'key', down, () => page.keyboard.up('-')));
  const blur = () => page.evaluate(() => window.dispatchEvent(new Event('blur')));
  measured.push(await jogs('left_joint1', 'focus lost', down, blur));
  await page.keyboard.up('-');
  const other = await open(browser, run.url);
  await other.click('[data-tab=jog]');
  await other.click('[data-panel=jog] [data-value=joints]');
  await other.waitForSelector('[data-jog="joint1+"]:enabled');
  measured.push(
    await jogs(
      'left_joint1',
      'page closed',
      () => press(other, 'joint1+'),
      () => other.close(),
    ),
  );
  await other.context().close();
  console.log(`at rest after: ${measured.join(', ')}`);
  // Another client has the arm: the refusal is in words, and nothing moves.
  const [held, holder] = [joint1(), await run.watch()];
  holder.send('lease', {arm: 'left'});
  await until('another client has the lease', () => run.arm('left').commander);
  await press(page, 'joint1+');
  await text(page, '#jog-report', /left is commanded by/);
  await page.mouse.up();
  holder.close();
  assert.ok(Math.abs(joint1() - held) < 1e-3);
  await page.click('[data-arm=guided] .card-head');
  await text(page, '#jog-missing', /no task of the run moves .* of guided; add to tasks/);
});

test('goals of two arms are planned, previewed and executed together', async () => {
  await page.click('[data-tab=move]');
  await page.click('[data-arm=left] .card-head');
  await page.click('[data-pose=home]');
  await page.click('[data-arm=right] .card-head');
  // What a joint does not reach is not taken, and the page says so while the field still has the focus.
  await page.fill('#sliders .slider:first-child .value', '99');
  await page.keyboard.press('Enter');
  await text(page, '#sliders .unit-note', /joint1 reaches .* to .* only/);
  assert.ok(Number(await page.inputValue('#sliders .slider:first-child .value')) < 9);
  await page.fill('#sliders .slider:first-child .value', '0.5');
  await page.keyboard.press('Tab');
  await text(page, '#sliders .unit-note', /^goal in rad$/);
  await text(page, '#goals', /left: home.*right: joints/);
  const start = run.positions('left');
  await page.fill('#plan-speed', '100');
  await page.click('#plan');
  await page.waitForSelector('#execute:enabled');
  await text(page, '#report', /left and right: planned in/);
  await page.click('#preview');
  assert.ok(near(run.positions('left'), start, 1e-3), 'preview moves nothing');
  await page.click('#execute');
  await text(page, '#report', /left and right: completed in/);
  assert.ok(near(run.positions('left'), HOME), `${run.positions('left')}`);
  assert.ok(Math.abs(run.positions('right')[0] - 0.5) < 0.01, `${run.positions('right')}`);
  await until('both leases are released', () => !run.arm('left').commander && !run.arm('right').commander);
});

test('waypoints are passed in one motion, and a dragged pose shows its joints', async () => {
  await page.click('[data-arm=left] .card-head');
  await page.fill('#sliders .slider:nth-child(1) .value', '0.4');
  await page.keyboard.press('Tab');
  await page.click('#waypoint-add');
  await page.waitForSelector('#waypoints li');
  await page.click('[data-pose=home]');
  await page.fill('#blend', '20');
  await page.click('#plan');
  await page.waitForSelector('#execute:enabled');
  await page.click('#execute');
  let farthest = 0;
  await until(
    'it completed',
    async () => {
      farthest = Math.max(farthest, joint1());
      return /completed/.test(await page.textContent('#report'));
    },
    20,
  );
  assert.ok(farthest > 0.2, `it passed the waypoint: joint 1 was at ${farthest} rad`);
  assert.ok(near(run.positions('left'), HOME));

  await page.click('[data-panel=move] [data-value=pose]');
  const fields = page.locator('.pose-fields .grid3 input');
  await fields.nth(1).fill('0.4');
  await text(page, '#reach', /reachable/);
  const before = run.positions('left');
  await fields.nth(0).fill('3');
  await text(page, '#reach', /no IK solution/);
  await fields.nth(0).fill('0.3');
  await text(page, '#reach', /reachable/);
  assert.ok(near(run.positions('left'), before, 1e-3), 'a ghost moves nothing');
  await page.click('#plan');
  await page.waitForSelector('#execute:enabled');
  await page.click('#execute');
  await text(page, '#report', /completed/);
  const {pose} = run.json('state').arms[0];
  assert.ok(near(pose.xyz.slice(0, 2), [0.3, 0.4], 2e-3), `${pose.xyz}`);
});

test('an arm is led by hand, its pose is saved, and it is held again; with motors off only if it is supported', async () => {
  await page.click('[data-arm=left] .card-head');
  await page.click('[data-tab=jog]');
  await page.click('#teach');
  await text(page, '#teach-report', /left cannot be led by hand: its protocol has no hand guiding/);
  await page.click('[data-arm=guided] .card-head');
  await page.waitForSelector('#support', {state: 'hidden'});
  await page.click('#teach');
  await text(page, '#teach-report', /guided: led by hand, motors on/);
  await text(page, '#strip', /guided is led by hand, motors on/);
  assert.equal(run.arm('guided').phase, 'led');
  await page.fill('.teach input[placeholder]', 'shown');
  await page.click('.teach .save button');
  await until('the pose is saved', () => JSON.stringify(run.json('pose', 'list')).includes('shown'));
  await page.click('#teach-end');
  await text(page, '#teach-report', /guided: ready, held where it is/);
  assert.equal(run.arm('guided').phase, 'ready');
  await text(page, '#strip', /guided ready/);

  await page.click('[data-arm=soft] .card-head');
  await page.waitForSelector('#support:visible');
  await until('soft is led with its motors off', async () => {
    // The emulated servos do not always answer in time on a busy computer.
    if (run.arm('soft').phase === 'held') run.dimos('arm', 'reset', 'soft');
    if (run.arm('soft').phase !== 'ready') run.dimos('arm', 'enable', 'soft');
    await page.waitForSelector('#support:visible');
    assert.ok(await page.isDisabled('#teach'), 'its motors go off: nothing without the tick');
    await page.check('#support');
    await page.click('#teach');
    return /soft: led by hand, motors off: support the arm/.test(await text(page, '#teach-report', /soft/));
  });
  assert.equal(run.arm('soft').enabled, false);
  assert.ok(!(await page.isChecked('#support')), 'each time is a deliberate one');
});

test('an arm that was selected just now is jogged as long as the key is held', async () => {
  await page.click('[data-tab=jog]');
  if ((await page.getAttribute('#jog-keys', 'aria-pressed')) !== 'true') await page.click('#jog-keys');
  await page.click('[data-arm=guided] .card-head');
  await text(page, '#jog-missing', /of guided/);
  // Both within one task of the page, so that no message of the run comes between.
  await page.evaluate(() => {
    document.querySelector('[data-arm=left] .card-head').click();
    window.dispatchEvent(new KeyboardEvent('keydown', {key: '-', code: 'Minus'}));
  });
  await page.waitForTimeout(3000);
  const [moved, speed] = [joint1(), watch.velocities.left_joint1];
  await page.evaluate(() => window.dispatchEvent(new KeyboardEvent('keyup', {key: '-', code: 'Minus'})));
  assert.ok(Math.abs(speed) > 0.01, `after 3 s it still moves: ${speed} rad/s at ${moved} rad`);
  await watch.resting('left_joint1');
});

test('Space is Stop where nothing is typed, also while a button of jog is held', async () => {
  await page.click('[data-tab=move]');
  await page.fill('.move .save input', 'a b');
  await page.focus('.move .save input');
  await page.keyboard.press('Space');
  assert.equal(run.arm('left').phase, 'ready', 'in a text field it is a space');
  await page.click('[data-arm=left] .card-head');
  await page.click('[data-tab=jog]');
  await page.click('[data-panel=jog] [data-value=joints]');
  await page.waitForSelector('[data-jog="joint1+"]:enabled');
  await press(page, 'joint1+');
  await watch.moving('left_joint1');
  await page.keyboard.press('Space');
  await text(page, '#stop-report', /left held at .*right held at/);
  await page.mouse.up();
  assert.deepEqual([run.arm('left').phase, run.arm('right').phase], ['held', 'held']);
  assert.deepEqual(page.errors, []);
});
