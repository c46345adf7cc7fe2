// The page on a log, a robot model and a blueprint, in a real browser: nothing is live.
import assert from 'node:assert/strict';
import {spawn} from 'node:child_process';
import {readFileSync, writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';
import {changed, environment, browser as launch, open, picture, Run, TIMEOUT, text, until} from './rig.mjs';

let browser, run;
const served = [];

before(async () => {
  [browser, run] = await Promise.all([launch(), Run.start('yourarm-planner', '--record', 'run.mcap')]);
});
after(async () => {
  for (const child of served) child.kill('SIGKILL');
  run?.end();
  await browser?.close();
});

/** Serves the page on a file; its URL. */
function view(...args) {
  const child = spawn(process.env.DIMOS, ['view', ...args], {env: environment(run.home), cwd: run.home});
  served.push(child);
  let [output, errors] = ['', ''];
  const url = new Promise((resolve, reject) => {
    child.stdout.on('data', (data) => {
      output += data;
      if (output.includes('\n')) resolve(output.trim());
    });
    child.stderr.on('data', (data) => (errors += data));
    child.on('exit', (code) => reject(new Error(`it ended with ${code}: ${errors}`)));
    setTimeout(() => reject(new Error(`no URL: ${errors}`)), TIMEOUT).unref();
  });
  return url.then((url) => ({url, child}));
}

/** With SHOTS=folder, pictures of the pages for people to look at. */
const shot = async (page, name) => {
  if (process.env.SHOTS) await page.screenshot({path: join(process.env.SHOTS, `${name}.png`)});
};
const joint = (page, row) => page.textContent(`.joints tbody tr:nth-child(${row}) td:nth-child(3)`);
const seek = (page, fraction) =>
  page.locator('#scrub').evaluate((range, fraction) => {
    range.value = String(Number(range.max) * fraction);
    range.dispatchEvent(new Event('input'));
  }, fraction);
const near = (value, expected, tolerance = 0.005) => Math.abs(Number(value.replace('−', '-')) - expected) < tolerance;

test('the log of a live run shows its arm, grows, and shows the run to its end', async () => {
  const {url, child} = await view('run.mcap');
  const page = await open(browser, url);
  await text(page, '#about', /live$/);
  await until('joint2 as at the start', async () => near(await joint(page, 2), -0.3));
  assert.equal(await page.locator('#stop').count(), 0, 'nothing can be stopped, or moved');
  assert.ok(!page.requests.some((request) => request.startsWith('ws:')), `${page.requests}`);
  const before = await picture(page);
  run.dimos('plan', 'arm', '--named', 'zero');
  run.dimos('execute');
  await until('the end of the log is at the goal', async () => {
    await page.keyboard.press('End');
    return near(await joint(page, 2), 0);
  });
  await until('the arm looks different', async () => (await changed(browser, before, await picture(page))) > 0.01);
  await text(page, '#events', /COMPLETED|completed/);
  await page.context().close();
  child.kill('SIGINT');
  assert.equal(await new Promise((resolve) => child.on('exit', resolve)), 130);
});

test('a log is scrubbed and played: arm, table, plan and marks', async () => {
  run.dimos('world', 'add', 'block', '--box', '0.1', '0.1', '0.1', '--at', '0.4', '0.3', '0.2');
  run.dimos('down');
  const {url} = await view('run.mcap');
  const page = await open(browser, url);
  await text(page, '#about', /complete$/);
  await page.waitForSelector('#marks .motion');
  await seek(page, 0);
  await until('the start in the table', async () => near(await joint(page, 2), -0.3));
  const start = await picture(page);
  const at = await page.locator('#marks .motion').evaluate((mark) => parseFloat(mark.style.left) / 100);
  const length = await page.evaluate(() => window.player.source.length);
  await seek(page, at + 0.3 / length);
  await until('the plan is shown', () =>
    page.evaluate(() => window.player.story.motionsAt(window.player.time).length > 0),
  );
  const moving = Number((await joint(page, 2)).replace('−', '-'));
  assert.ok(moving > -0.31 && moving < -0.001, `on its way: ${moving}`);
  await until('the plan looks different', async () => (await changed(browser, start, await picture(page))) > 0.005);
  await seek(page, at + 1.6 / length);
  await page.waitForTimeout(300);
  await shot(page, 'log');
  await seek(page, 1);
  await until('the end in the table', async () => near(await joint(page, 2), 0));
  assert.ok((await changed(browser, start, await picture(page))) > 0.01);
  assert.deepEqual(await page.evaluate(() => window.player.world.map(({name}) => name)), ['table', 'block']);
  await seek(page, 0);
  await page.selectOption('#rate', '10');
  await page.click('#play');
  await until('it played to its end', async () => near(await joint(page, 2), 0));
  const coloured = await page
    .locator('.plot canvas')
    .first()
    .evaluate((canvas) => {
      const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
      // Axes are grey.
      let count = 0;
      for (let i = 0; i < data.length; i += 4)
        count += data[i + 3] > 128 && Math.abs(data[i] - data[i + 2]) > 60 ? 1 : 0;
      return count;
    });
  assert.ok(coloured > 300, `the joints are drawn: ${coloured} pixels`);
  await page.locator('.events .seekable').first().click();
  for (const width of [1100, 1280, 1400]) {
    await page.setViewportSize({width, height: 760});
    const [end, choice] = await page.evaluate(() => [
      Math.max(...[...document.querySelectorAll('.plot-head > *')].map((each) => each.getBoundingClientRect().right)),
      document.querySelector('.plots > .choice').getBoundingClientRect().left,
    ]);
    assert.ok(end <= choice, `${width}: the heads of the plots end at ${end}, the time span is chosen at ${choice}`);
  }
  assert.deepEqual(page.errors, []);
  await page.context().close();
});

test('a log that was cut is shown up to the cut', async () => {
  const whole = join(run.home, 'run.mcap');
  const bytes = readFileSync(whole);
  writeFileSync(join(run.home, 'cut.mcap'), bytes.subarray(0, bytes.length * 0.7));
  const {url} = await view('cut.mcap');
  const page = await open(browser, url);
  await text(page, '#about', /not whole: it ends at byte/);
  await until('joint2 as at the start', async () => near(await joint(page, 2), -0.3));
  await page.context().close();
});

test('the sliders of a model move it, and a pose that collides is reported', async () => {
  const {url} = await view('builtin:yourarm');
  const page = await open(browser, url);
  await text(page, '#verdict', /Nothing touches/);
  await text(page, '#tcp', /xyz/);
  const before = await picture(page);
  const slide = (name, fraction) =>
    page.locator(`[data-joint=${name}]`).evaluate((range, fraction) => {
      range.value = String(Number(range.max) * fraction);
      range.dispatchEvent(new Event('input'));
    }, fraction);
  await slide('joint3', 1);
  await slide('joint5', 1);
  await text(page, '#verdict', /pairs? touch/);
  assert.ok((await changed(browser, before, await picture(page))) > 0.02);
  await shot(page, 'model');
  assert.match(await page.textContent('#pairs .touches'), /link|flange|forearm|arm/);
  await page.click('[data-tab=limits]');
  assert.equal(await page.locator('#limits tr').count(), 6);
  await page.click('[data-tab=ignored]');
  await text(page, '#ignored', /neighbours/);
  await page.click('text=all 0');
  await page.click('[data-tab=checks]');
  await text(page, '#verdict', /Nothing touches/);
  assert.deepEqual(page.errors, []);
  await page.context().close();
});

test('a blueprint is shown with its poses and obstacles; a wrong token shows nothing', async () => {
  const {url} = await view('yourarm-planner');
  const page = await open(browser, url);
  await text(page, '#banner', /BLUEPRINT/);
  await page.click('[data-pose=home]');
  await until('home', async () => near(await page.inputValue('.slider:nth-child(2) .value'), -0.3));
  await shot(page, 'blueprint');
  await page.context().close();
  const stranger = await open(browser, url.replace(/#.*/, '#00000000000000000000000000000000'));
  await text(stranger, '#message', /refuses this token/);
  assert.equal(await stranger.locator('#view').count(), 0);
  await stranger.context().close();
});

test('on a phone nothing is wider than the screen', async () => {
  for (const [what, tabs] of [
    ['run.mcap', ['arms', 'events', 'plots']],
    ['builtin:yourarm', ['arms', 'checks', 'limits', 'ignored']],
  ]) {
    const phone = await open(browser, (await view(what)).url, {width: 390, height: 844});
    await phone.waitForSelector('#view canvas');
    for (const tab of tabs) {
      await phone.click(`[data-tab=${tab}]`);
      assert.ok((await phone.evaluate(() => document.documentElement.scrollWidth)) <= 390, `${what}: ${tab}`);
      await shot(phone, `phone-${what}-${tab}`);
    }
    await phone.context().close();
  }
});
