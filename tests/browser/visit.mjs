// A visit to the page in a headless Chromium, with the network off but for the local server: what happened, as JSON.
// Keys are names, one after another; or a table from macrostates to keys, pressed until the episode ends; or "watch",
// which presses none and waits for the end of the episode that the page plays.

import { createRequire } from 'node:module';

const [modules, chromium, address, width, picture, world, keys] = process.argv.slice(2);
const { chromium: engine } = createRequire(`${modules}/`)('playwright-core');
const browser = await engine.launch({ executablePath: chromium, args: ['--no-sandbox', '--enable-unsafe-swiftshader'] });
const page = await browser.newPage({ viewport: { width: Number(width), height: 900 } });
const outside = [];
const errors = [];
await page.route('**/*', (route) => {
  if (route.request().url().startsWith(address) || route.request().url().startsWith('data:')) return route.continue();
  outside.push(route.request().url());
  return route.abort();
});
page.on('pageerror', (error) => errors.push(error.message));
page.on('dialog', (dialog) => errors.push(`a dialog opened: ${dialog.message()}`));
const began = Date.now();
await page.goto(`${address}/index.html?${world}`);
await page.waitForSelector('body[data-ready]', { timeout: 60_000 });
await page.evaluate(() => new Promise((shown) => requestAnimationFrame(() => requestAnimationFrame(shown))));
const ready = (Date.now() - began) / 1000; // keys work, and the first image is drawn
const pressed = [];
const press = async (key) => {
  pressed.push(key);
  await page.keyboard.press(key);
  await page.waitForFunction(() => document.body.dataset.moving !== 'yes', null, { timeout: 60_000 });
};
if (keys === 'watch') {
  await page.selectOption('#speed', '1000');
  await page.waitForFunction(() => document.body.dataset.end, null, { timeout: 120_000 });
} else if (keys.startsWith('{')) {
  const table = JSON.parse(keys);
  for (let seen = await page.evaluate(() => ({ ...document.body.dataset })); !seen.end;) {
    for (const key of table[seen.state].split(' ')) await press(key);
    seen = await page.evaluate(() => ({ ...document.body.dataset }));
  }
} else {
  for (const key of keys.split(' ').filter(Boolean)) await press(key);
}
const seen = await page.evaluate(() => ({
  ...document.body.dataset,
  happened: document.getElementById('happened').textContent,
  loading: document.getElementById('loading').hidden ? '' : document.getElementById('loading').textContent,
  overflow: document.documentElement.scrollWidth - window.innerWidth,
}));
await page.waitForTimeout(1000);
await page.screenshot({ path: picture, fullPage: true });
await browser.close();
process.stdout.write(JSON.stringify({ ...seen, pressed, ready_s: ready, outside, errors }));
