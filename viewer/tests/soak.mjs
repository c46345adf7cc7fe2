// The page for a long time (DIMOS_PAGE_SOAK minutes): motions, jogging, dragged poses and lost connections, while
// neither its heap nor the memory of the run may grow.
import assert from 'node:assert/strict';
import {readdirSync, readFileSync} from 'node:fs';
import {test} from 'node:test';
import {browser as launch, open, Run, text, until} from './rig.mjs';

const MINUTES = Number(process.env.DIMOS_PAGE_SOAK ?? 60);
/** Part of the time after which histories, lists and caches are full. */
const WARM = 0.3;
/**
 * Most that may be added after that. In a short run the list of events is not full by then: 200 of 3 elements. Sockets
 * of lost connections may still be open. Nodes and listeners are not counted: to undo what was typed, the browser keeps
 * fields that the page has removed.
 */
const LARGEST = {heap: 2e6, elements: 650, geometries: 20, resident: 6e6, files: 16};

test(`nothing grows in ${MINUTES} min`, {timeout: (MINUTES + 5) * 60_000}, async () => {
  const blueprint = new URL('acts.yaml', import.meta.url).pathname;
  const [browser, run] = await Promise.all([launch(), Run.start(blueprint)]);
  try {
    const page = await open(browser, run.url);
    const session = await page.context().newCDPSession(page);
    await text(page, '#age', /^live$/);
    const began = Date.now();
    const part = () => (Date.now() - began) / (MINUTES * 60_000);
    let [warm, cycles] = [null, 0];
    while (part() < 1) {
      await cycle(page, cycles++).catch((error) => release(run, error));
      const now = await measure(session, page, run.child.pid);
      console.log(`${(part() * MINUTES).toFixed(1)} min, cycle ${cycles}: ${JSON.stringify(now)}`);
      if (part() < WARM || !warm) warm = now;
      for (const [what, most] of Object.entries(LARGEST)) {
        const [from, to] = [warm[what], now[what]];
        assert.ok(to <= from + most, `${what} grew from ${from} to ${to} in ${cycles} cycles`);
      }
    }
    assert.deepEqual(
      page.errors.filter((error) => !/WebSocket|net::/.test(error)),
      [],
    );
  } finally {
    run.end();
    await browser.close();
  }
});

/** Goes on where a computer that was too busy held an arm; any other error ends the test. */
function release(run, error) {
  const held = run.json('status')[0].arms.filter(({phase, hardware_id}) => phase === 'held' && hardware_id !== 'soft');
  if (!held.length) throw error;
  for (const {hardware_id: arm, cause} of held) {
    console.log(`${arm} was held: ${cause?.text}`);
    run.dimos('arm', 'reset', arm);
    run.dimos('arm', 'enable', arm);
  }
}

/** What people do with a page. */
async function cycle(page, number) {
  await page.click('[data-tab=move]');
  for (const arm of ['left', 'right']) {
    await page.click(`[data-arm=${arm}] .card-head`);
    await page.click('[data-panel=move] [data-value=joints]');
    await page.fill('#sliders .slider:first-child .value', number % 2 ? '0' : '0.5');
    await page.keyboard.press('Tab');
  }
  await page.fill('#plan-speed', '100');
  await page.click('#plan');
  await page.waitForSelector('#execute:enabled');
  await page.click('#preview');
  await page.click('#execute');
  assert.match(await text(page, '#report', /completed in|held|aborted/i), /completed in/);
  await page.click('[data-arm=left] .card-head');
  await page.click('[data-panel=move] [data-value=pose]');
  const y = page.locator('.pose-fields .grid3 input').nth(1);
  for (let step = 0; step < 20; step++) await y.fill(String(0.3 + 0.005 * step));
  await text(page, '#reach', /./);
  await page.click('#clear');
  await page.click('[data-tab=jog]');
  for (const key of ['y+', 'y-']) {
    await page.waitForSelector(`[data-jog="${key}"]:enabled`);
    const {x, y, width, height} = await page.locator(`[data-jog="${key}"]`).boundingBox();
    await page.mouse.move(x + width / 2, y + height / 2);
    await page.mouse.down();
    await page.waitForTimeout(1000);
    await page.mouse.up();
    await until('the jog has ended', async () => !(await page.textContent('#jog-report')).includes('is jogged'));
  }
  await page.evaluate(() => {
    for (const each of [window.dimos.run.work, window.dimos.run.watch]) each.drop();
  });
  await text(page, '#age', /^live$/);
}

async function measure(session, page, pid) {
  await session.send('HeapProfiler.collectGarbage');
  const {usedSize: heap} = await session.send('Runtime.getHeapUsage');
  const {geometries} = await page.evaluate(() => window.dimos.memory);
  const elements = await page.locator('*').count();
  const status = readFileSync(`/proc/${pid}/status`, 'utf8');
  const resident = 1024 * Number(/VmRSS:\s+(\d+)/.exec(status)[1]);
  return {heap, elements, geometries, resident, files: readdirSync(`/proc/${pid}/fd`).length};
}
