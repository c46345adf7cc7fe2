// The page of a live run in a real browser: what it shows, and what its clicks do to the run.
import assert from 'node:assert/strict';
import {after, before, test} from 'node:test';
import {changed, browser as launch, open, picture, Run, text, until} from './rig.mjs';

const HOME = [0, -0.3, 0.6, 0, 0.8, 0];
let browser, run, page;

before(async () => {
  [browser, run] = await Promise.all([launch(), Run.start('yourarm-planner')]);
  page = await open(browser, run.url);
});
after(async () => {
  run?.end();
  await browser?.close();
});

const near = (a, b, tolerance = 0.01) => a.every((value, i) => Math.abs(value - b[i]) < tolerance);
const click = (selector) => page.click(selector);

test('it loads from the run alone, and moves nothing', async () => {
  await text(page, '#age', /^live$/);
  await text(page, '.joints tbody', /joint6/);
  assert.equal(await page.textContent('#banner'), 'SIMULATED');
  const origin = new URL(run.url).host;
  const outside = page.requests.filter((url) => !url.startsWith('data:') && new URL(url).host !== origin);
  assert.deepEqual(outside, [], 'requests to other hosts');
  assert.ok(page.requests.length >= 4, `the page, the scene and two sockets: ${page.requests}`);
  assert.deepEqual(page.errors, [], 'such as a violation of the Content-Security-Policy');
  assert.ok(near(run.positions(), HOME));
  assert.equal(run.arm().commander ?? null, null, 'the page has no lease');
});

test('the arm on screen moves when another program moves it', async () => {
  let before, rest;
  await until('the view is at rest', async () => {
    before = await picture(page);
    rest = await changed(browser, before, await picture(page));
    return rest < 0.001;
  });
  const frames = () => page.evaluate(() => window.dimos.measured.frames);
  await until('no frame is drawn at rest', async () => {
    const drawn = await frames();
    await page.waitForTimeout(400);
    return (await frames()) === drawn;
  });
  run.dimos('move', 'arm', '--named', 'zero');
  await until('joint2 at zero in the table', async () =>
    /^joint20\.000/.test(await page.textContent('.joints tbody tr:nth-child(2)')),
  );
  let moved = 0;
  await until('the arm looks different', async () => {
    moved = await changed(browser, before, await picture(page));
    return moved > 0.01;
  });
  console.log(`pixels changed: ${(rest * 100).toFixed(3)} % at rest, ${(moved * 100).toFixed(1)} % after the motion`);
});

test('a goal is planned, previewed and executed by clicks, and nothing moves before Execute', async () => {
  const start = run.positions();
  assert.ok((await page.isDisabled('#plan')) && (await page.isDisabled('#execute')), 'no goal yet');
  const empty = await picture(page);
  await click('[data-pose=home]');
  await until('the goal is shown', async () => (await changed(browser, empty, await picture(page))) > 0.005);
  await click('#plan');
  await page.waitForSelector('#execute:enabled');
  assert.match(await page.textContent('#report'), /planned in \d+ ms.* s · .*clearance/);
  const end = await page.inputValue('#scrub');
  await click('#preview');
  await page.waitForFunction((end) => document.querySelector('#scrub').value !== end, end);
  assert.ok(near(run.positions(), start, 1e-3), 'preview moves the ghost only');
  await click('#execute');
  await text(page, '#report', /completed in .* final error/);
  assert.ok(near(run.positions(), HOME), `${run.positions()}`);
  await until('the lease is released', () => !run.arm().commander);
});

test('an obstacle is added by hand, in the way of a goal, and removed', async () => {
  await click('[data-tab=world]');
  await page.fill('#object-name', 'block');
  for (const [index, value] of ['0.4', '0', '0.55'].entries()) {
    await page.locator('#object-at input').nth(index).fill(value);
  }
  await click('#object-add');
  await page.waitForSelector('[data-object=block]');
  const block = run.json('world', 'list').objects.find((object) => object.name === 'block');
  assert.deepEqual(block.pose.xyz, [0.4, 0, 0.55]);
  // Another one of that name does not take its place.
  await page.fill('#object-name', 'block');
  await page.locator('#object-at input').first().fill('0.9');
  await click('#object-add');
  await text(page, '#notice', /there is an obstacle named block/);
  assert.deepEqual(run.json('world', 'list').objects.find(({name}) => name === 'block').pose.xyz, [0.4, 0, 0.55]);
  await click('#notice >> text=✕');
  await page.fill('#object-name', '');
  await click('[data-tab=move]');
  await click('[data-pose=zero]');
  await click('#plan');
  await text(page, '#report', /block/);
  assert.ok(await page.isDisabled('#execute'));
  await click('[data-tab=world]');
  await click('[data-object=block] >> text=Remove');
  await until('it is removed', () => !run.json('world', 'list').objects.some((object) => object.name === 'block'));
  await click('[data-tab=move]');
});

test('Stop holds the moving arm and says so; Reset and Enable are separate acts', async () => {
  await page.fill('#plan-speed', '5');
  await click('[data-pose=zero]');
  await click('#plan');
  await page.waitForSelector('#execute:enabled');
  await click('#execute');
  await until('it moves', () => !near(run.positions(), HOME, 0.01));
  await page.keyboard.press('Escape');
  assert.match(await text(page, '#stop-report', /held at/), /^arm held at \d\d:\d\d:\d\d\.\d{3} \(\d+ ms\)$/);
  assert.equal(run.arm().phase, 'held');
  const held = run.positions();
  assert.ok(!near(held, [0, 0, 0, 0, 0, 0], 0.02), 'stopped on the way');
  await text(page, '.card', /held: stopped by an operator/);
  await click('.reset');
  await until('reset', () => run.arm().phase === 'standby');
  await click('.enable');
  await until('ready', () => run.arm().phase === 'ready');
  await until('the card is clean', async () => !/aborted|held/.test(await page.textContent('.card')));
  await until('the report of the stop is gone', async () => (await page.textContent('#stop-report')) === '');
  assert.ok(near(run.positions(), held, 1e-3), 'neither moves the arm');
});

test('at rest Escape leaves what is open or typed, and stops nothing', async () => {
  await click('footer button');
  await page.waitForSelector('#licences[open]');
  await page.keyboard.press('Escape');
  await page.waitForSelector('#licences', {state: 'hidden'});
  await page.focus('#sliders .value');
  await page.keyboard.press('Escape');
  assert.equal(await page.evaluate(() => document.activeElement.tagName), 'BODY');
  await page.waitForTimeout(300);
  assert.equal(run.arm().phase, 'ready');
  // While the arm moves, Escape is Stop, also in a field.
  await page.fill('#plan-speed', '5');
  await click('[data-pose=zero]');
  await click('#plan');
  await page.waitForSelector('#execute:enabled');
  const before = run.positions();
  await click('#execute');
  await until('it moves', () => !near(run.positions(), before, 0.01));
  await page.focus('#sliders .value');
  await page.keyboard.press('Escape');
  await until('it is held', () => run.arm().phase === 'held');
  await until('the page has released the arm', () => !run.arm().commander);
  run.dimos('arm', 'reset', 'arm');
  run.dimos('arm', 'enable', 'arm');
});

test('tabs and sliders are what they are to assistive technology', async () => {
  await page.focus('[role=tab][aria-selected=true]');
  await page.keyboard.press('ArrowRight');
  assert.equal(await page.evaluate(() => document.activeElement.textContent), 'Jog');
  assert.equal(await page.getAttribute('[role=tabpanel]', 'aria-labelledby'), 'tab-jog');
  await text(page, '#jog-checked', /^Stops before what the planner knows/);
  await page.keyboard.press('ArrowLeft');
  await page.waitForSelector('#sliders input:visible');
  const says = await page.getAttribute('#sliders input', 'aria-valuetext');
  assert.match(says, /^-?\d\.\d{3} rad$/);
  assert.match(await page.getAttribute('#speed', 'aria-valuetext'), /^\d+ %$/);
});

test('the colours of the joints differ without red and green, too', async () => {
  // Machado, Oliveira and Fernandes (2009), severity 1.
  const sights = {
    normal: [1, 0, 0, 0, 1, 0, 0, 0, 1],
    deuteranopia: [0.367, 0.861, -0.228, 0.28, 0.673, 0.047, -0.012, 0.043, 0.969],
    protanopia: [0.152, 1.053, -0.205, 0.115, 0.786, 0.099, -0.004, -0.048, 1.052],
  };
  const styles = await page
    .locator('.swatch')
    .evaluateAll((all) => all.map((one) => one.style.getPropertyValue('--color')));
  const linear = (hex) => [1, 3, 5].map((at) => (Number.parseInt(hex.slice(at, at + 2), 16) / 255) ** 2.2);
  const lab = ([r, g, b]) => {
    const root = (value) => Math.cbrt(Math.max(0, value));
    const [x, y, z] = [
      root((0.412 * r + 0.358 * g + 0.18 * b) / 0.95),
      root(0.213 * r + 0.715 * g + 0.072 * b),
      root((0.019 * r + 0.119 * g + 0.951 * b) / 1.089),
    ];
    return [116 * y, 500 * (x - y), 200 * (y - z)];
  };
  assert.equal(styles.length, 6);
  for (const [sight, m] of Object.entries(sights)) {
    const seen = styles.map((hex) => {
      const c = linear(hex.trim());
      return lab([0, 3, 6].map((row) => m[row] * c[0] + m[row + 1] * c[1] + m[row + 2] * c[2]));
    });
    seen.forEach((a, i) => {
      for (const [j, b] of seen.slice(0, i).entries())
        assert.ok(Math.hypot(...a.map((v, k) => v - b[k])) > 20, `joints ${j + 1} and ${i + 1}: ${sight}`);
    });
  }
});

/** What of an element a person can see and touch: its rectangle inside the window, if nothing lies over its middle. */
const seen = (page, selector) =>
  page.evaluate((selector) => {
    const element = document.querySelector(selector);
    const {left, top, right, bottom, width, height} = element.getBoundingClientRect();
    const inside = left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight && width > 0 && height > 0;
    const over = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
    return inside && (element.contains(over) || over?.contains(element)) ? {left, top, right, bottom} : null;
  }, selector);

test('what keeps an arm from moving is seen on every screen and tab, and Stop is within reach', async () => {
  run.dimos('stop');
  run.dimos('speed', '30%');
  await text(page, '#strip', /speed 30 %/);
  assert.match(await text(page, '#strip', /held/), /arm held: stopped by an operator/);
  for (const [width, height] of [
    [390, 844],
    [844, 390],
    [600, 960],
    [960, 600],
    [1024, 768],
    [768, 1024],
    [1920, 1080],
  ]) {
    await page.setViewportSize({width, height});
    for (const tab of ['move', 'jog', 'world', 'events', ...(width <= 960 ? ['arms', 'plots'] : [])]) {
      const where = `${width} x ${height}, ${tab}`;
      await click(`[data-tab=${tab}]`);
      assert.ok(await seen(page, '#strip .bad'), `the held arm: ${where}`);
      assert.ok(await seen(page, '#strip .warn'), `the speed: ${where}`);
      assert.ok(await seen(page, '#stop'), `Stop: ${where}`);
      if (tab === 'jog') assert.ok(await seen(page, '#jog-rows .hold'), `a jog button: ${where}`);
      if (tab === 'move') assert.ok(await seen(page, '#sliders input'), `a slider beside the buttons: ${where}`);
    }
    if (process.env.DIMOS_PICTURES)
      await page.screenshot({path: `${process.env.DIMOS_PICTURES}/${width}x${height}.png`});
  }
  await page.setViewportSize({width: 1200, height: 760});
  await click('[data-tab=move]');
  run.dimos('speed', '100%');
  run.dimos('arm', 'reset', 'arm');
  run.dimos('arm', 'enable', 'arm');
  await text(page, '#strip', /^arm ready$/);
});

test('a page that is opened later shows how it came about', async () => {
  const later = await open(browser, run.url);
  const opened = Date.now() / 1000;
  await text(later, '#age', /^live$/);
  await later.click('[data-tab=events]');
  await text(later, '#events', /arm is held \(stopped by an operator\)/);
  const [times, joint2] = await later.evaluate(() => {
    const [times, , joint2] = window.dimos.history.arms.get('arm').position.since(0, 10_000, false);
    return [times, joint2];
  });
  assert.ok(times[0] < opened - 2, `begins ${opened - times[0]} s before it was opened`);
  assert.ok(Math.max(...joint2) - Math.min(...joint2) > 0.2, 'the motions that the other page has seen');
  await later.context().close();
});

test('a wrong token shows nothing of the run', async () => {
  const stranger = await open(browser, run.url.replace(/#.*/, '#00000000000000000000000000000000'));
  await text(stranger, '#message', /refuses this token/);
  assert.equal(await stranger.locator('#view').count(), 0);
  const code = await stranger.evaluate(
    () =>
      new Promise((resolve) => {
        const socket = new WebSocket(`ws://${location.host}/rpc`);
        socket.onopen = () => socket.send('{"token":"wrong"}');
        socket.onclose = ({code}) => resolve(code);
      }),
  );
  assert.equal(code, 4401);
  await stranger.context().close();
});

test('on a phone, Stop is on screen and nothing is wider than it', async () => {
  const phone = await open(browser, run.url, {width: 390, height: 844});
  await text(phone, '#age', /^live$/);
  for (const tab of ['arms', 'move', 'jog', 'world', 'events', 'plots']) {
    await phone.click(`[data-tab=${tab}]`);
    const {width, stop} = await phone.evaluate(() => {
      const at = document.querySelector('#stop').getBoundingClientRect();
      const top = document.elementFromPoint(at.x + at.width / 2, at.y + at.height / 2);
      return {
        width: document.documentElement.scrollWidth,
        stop: at.bottom <= innerHeight && top?.closest('#stop') !== null,
      };
    });
    assert.ok(width <= 390 && stop, `${tab}: ${width} px wide, Stop reachable: ${stop}`);
  }
  await phone.context().close();
});

// The last ones: the run was suspended, so its arms are held afterwards.
test('a lost connection is shown, disables acts, and recovers', async () => {
  run.child.kill('SIGSTOP');
  await text(page, '#age', /^no data for \d/);
  await text(page, '#age', /^connection lost/);
  await page.waitForSelector('#pause:disabled');
  assert.ok(await page.isDisabled('#plan'));
  assert.ok(await page.isEnabled('#stop'));
  await click('#stop');
  await text(page, '#stop-report', /NOT CONFIRMED/);
  run.child.kill('SIGCONT');
  await text(page, '#age', /^live$/);
  await page.waitForSelector('#pause:enabled');
  await text(page, '#events', /the process did not run|held/);
  const events = await page.locator('#events li').allTextContents();
  assert.deepEqual([...new Set(events)], events, 'each event once');
  assert.deepEqual(
    page.errors.filter((text) => !/WebSocket|net::/.test(text)),
    [],
  );
});

test('a page does not command the run that has taken the address of its own', async () => {
  // To that run its token is a wrong one.
  await page.evaluate(() => {
    for (const link of [window.dimos.run.work, window.dimos.run.watch]) {
      link.token = 'f'.repeat(32);
      link.drop();
    }
  });
  await text(page, '#age', /^another run has taken this address/);
  await page.waitForSelector('#pause:disabled');
  await page.waitForTimeout(1500);
  assert.match(await page.textContent('#age'), /^another run/, 'and it does not try again');
});
