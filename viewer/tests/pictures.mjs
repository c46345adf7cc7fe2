// Pictures of the arms' pages: each shipped planner with a motion that is planned, as the page of the live view draws
// it. `make screenshots` writes them to docs/images; names of pages limit it to those.
import {writeFileSync} from 'node:fs';
import {browser as launch, open, Run, text} from './rig.mjs';

/** Page, blueprint, and how far each joint goes from the pose `home` [rad]. */
const ARMS = [
  ['xarm', 'xarm6-planner', [-0.9, 0.2, -0.2, 0, 0, 0]],
  ['ur', 'ur5e-planner', [-0.9, 0.3, 0.2, -0.5, 0, 0]],
  ['franka', 'fr3-planner', [-0.9, 0.2, 0, 0.2, 0, 0, 0]],
  ['piper', 'piper-planner', [-0.9, 0.3, -0.2, 0, 0, 0]],
  ['so101', 'so101-planner', [-0.9, 0.2, -0.3, 0.1, 0]],
];
const SIZE = {width: 1500, height: 780};
const MOST = 60_000; // bytes

/** A picture of the view as WebP. */
async function webp(browser, png) {
  const page = await browser.newPage();
  const data = await page.evaluate(
    async (url) => {
      const image = new Image();
      image.src = url;
      await image.decode();
      const canvas = Object.assign(document.createElement('canvas'), {width: image.width, height: image.height});
      canvas.getContext('2d').drawImage(image, 0, 0);
      return canvas.toDataURL('image/webp', 0.85).split(',')[1];
    },
    `data:image/png;base64,${png.toString('base64')}`,
  );
  await page.close();
  return Buffer.from(data, 'base64');
}

const browser = await launch();
const only = process.argv.slice(2);
for (const [name, blueprint, by] of ARMS.filter(([name]) => !only.length || only.includes(name))) {
  const run = await Run.start(blueprint, '--sim');
  try {
    if (run.arm().phase !== 'ready') run.dimos('arm', 'enable', 'arm');
    run.dimos('move', 'arm', '--named', 'home', '--speed', '1');
    const page = await open(browser, run.url, SIZE);
    page.setDefaultTimeout(120_000);
    await text(page, '#age', /^live$/);
    const from = run.positions();
    for (const [joint, angle] of by.entries()) {
      await page.fill(`#sliders .slider:nth-child(${joint + 1}) .value`, (from[joint] + angle).toFixed(3));
      await page.keyboard.press('Tab');
    }
    await page.click('#plan');
    await page.waitForSelector('#execute:enabled');
    await page.addStyleTag({content: '.toolbar, .timeline, .arm-label { display: none !important; }'});
    await page.waitForTimeout(1000);
    const picture = await webp(browser, await page.locator('#view').screenshot());
    if (picture.length > MOST) throw new Error(`${name}: ${picture.length} bytes`);
    writeFileSync(new URL(`../../docs/images/${name}.webp`, import.meta.url), picture);
    console.log(`docs/images/${name}.webp: ${picture.length} bytes`);
  } finally {
    run.end();
  }
}
await browser.close();
