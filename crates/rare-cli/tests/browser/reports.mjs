// Opens reports in headless Chromium and checks that they do what they promise.
//
//   node reports.mjs [--screenshots FOLDER] [--limit SECONDS] REPORT.html ...
//
// The browser is $CHROMIUM or /usr/bin/chromium. A page with the section of the viewer is checked as the report of a
// registration, any other as the index of an evaluation. Ends with 1 and a message at the first failure; skips, and says
// so, where there is no browser and $CHROMIUM is not set.

import { existsSync, mkdirSync } from "node:fs";
import { basename, join, resolve } from "node:path";
import { fileURLToPath, pathToFileURL } from "node:url";

import { chromium } from "playwright-core";

const browserArguments = [
  "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic", "--no-first-run",
];
const viewport = { width: 1280, height: 800 };

class Failure extends Error {}

function demand(condition, message) {
  if (!condition) throw new Failure(message);
}

function readArguments(words) {
  const options = { files: [], screenshots: null, limit: 20 };
  while (words.length > 0) {
    const word = words.shift();
    if (word === "--screenshots") options.screenshots = words.shift();
    else if (word === "--limit") options.limit = Number(words.shift());
    else options.files.push(word);
  }
  demand(options.files.length > 0, "name at least one report");
  return options;
}

/** Opens a file; `problems` collects what must not happen. */
async function open(browser, file, options, context = {}) {
  const page = await browser.newPage({ viewport, ...context });
  const problems = [];
  page.on("console", (message) => { if (message.type() === "error") problems.push(`console: ${message.text()}`); });
  page.on("pageerror", (error) => problems.push(`page: ${error.message}`));
  page.on("dialog", (dialog) => { problems.push(`dialog: ${dialog.message()}`); dialog.dismiss(); });
  page.on("request", (request) => { if (!/^(file|data|blob):/.test(request.url())) problems.push(`request: ${request.url()}`); });
  const start = Date.now();
  await page.goto(pathToFileURL(resolve(file)).href);
  await page.waitForFunction(() => document.documentElement.dataset.ready === "true", null, { timeout: options.limit * 1000 })
    .catch(() => { throw new Failure(`not ready within ${options.limit} s; ${problems.join("; ")}`); });
  return { page, problems, seconds: (Date.now() - start) / 1000 };
}

// ---- the report of a registration

/** A sum of the picture that changes with it, its number of colours, and the share that is not background. */
async function picture(page) {
  return page.evaluate(() => {
    const { width, height, data } = window.rareReport.pixels();
    const words = new Uint32Array(data.buffer);
    const colours = new Map();
    let sum = 0;
    for (const word of words) {
      sum = (Math.imul(sum, 31) + word) | 0;
      colours.set(word, (colours.get(word) ?? 0) + 1);
    }
    const background = Math.max(...colours.values());
    return { sum, colours: colours.size, covered: 1 - background / (width * height) };
  });
}

async function differs(page, before, what) {
  const after = await picture(page);
  demand(after.sum !== before.sum, `${what} does not change the picture`);
  return after;
}

async function checkViewer(page) {
  const shown = await page.evaluate(() => window.rareReport.viewer) === "shown";
  demand(shown, `the viewer is missing: ${await page.locator("#viewer").textContent()}`);
  const first = await picture(page);
  demand(first.colours > 10, `the picture has only ${first.colours} colours`);
  demand(first.covered > 0.01, `points cover only ${(100 * first.covered).toFixed(2)} % of the picture`);
  await page.locator("#viewer canvas").focus();
  await page.keyboard.press("t");
  const toggled = await differs(page, first, "the key t");
  await page.keyboard.press("t");
  demand((await picture(page)).sum === first.sum, "the key t pressed twice does not restore the picture");
  await page.keyboard.press("1");
  await differs(page, first, "the key 1");
  await moveSlider(page, "Blend between poses", 0.3);
  const blended = await differs(page, toggled, "the slider");
  demand(blended.sum !== first.sum, "the slider does not change the picture");
  await page.keyboard.press("ArrowLeft");
  await differs(page, blended, "an arrow key");
  await page.keyboard.press("t");
  await checkColours(page);
  await checkPresets(page);
  await checkLines(page);
  await checkRest(page);
}

/** Nothing may be drawn while nothing changes. */
async function checkRest(page) {
  await page.waitForTimeout(600);
  const frames = await page.evaluate(async () => {
    const request = window.requestAnimationFrame;
    let calls = 0;
    window.requestAnimationFrame = (callback) => { calls += 1; return request.call(window, callback); };
    await new Promise((done) => { setTimeout(done, 500); });
    window.requestAnimationFrame = request;
    return calls;
  });
  demand(frames === 0, `the viewer asks for ${frames} frames in half a second of rest`);
}

async function moveSlider(page, label, share) {
  await page.getByLabel(label, { exact: true }).first().evaluate((input, to) => {
    input.value = Number(input.min) + to * (input.max - input.min);
    input.dispatchEvent(new Event("input", { bubbles: true }));
  }, share);
}

async function checkColours(page) {
  let before = await picture(page);
  for (const mode of ["residual", "visibility", "cloud"]) {
    await page.locator(`input[name=colour][value=${mode}]`).check({ force: true });
    before = await differs(page, before, `colouring by ${mode}`);
  }
}

async function checkPresets(page) {
  let before = await picture(page);
  for (const name of ["From above", "Reference view", "Everything"]) {
    await page.getByRole("button", { name, exact: true }).click();
    before = await differs(page, before, `the view "${name}"`);
  }
}

async function checkLines(page) {
  if (await page.locator(".panel .check").count() < 3) return;
  const before = await picture(page);
  await page.locator("#viewer canvas").focus();
  await page.keyboard.press("2");
  await page.keyboard.press("l");
  await differs(page, before, "showing correspondences");
  await page.keyboard.press("l");
  await moveSlider(page, "Pull clouds apart", 0.5);
  await differs(page, before, "pulling the clouds apart");
  await moveSlider(page, "Pull clouds apart", 0);
  await page.evaluate((last) => window.rareReport.blend(last), 99);
}

async function checkSetTable(page) {
  const table = page.locator("#sets table");
  if (await table.count() === 0) return;
  const column = () => table.locator("tbody td:nth-child(2)").allTextContents().then((cells) => cells.map((cell) => Number(cell.replaceAll(",", ""))));
  const head = table.locator("thead th:nth-child(2)");
  await head.getByRole("button").click();
  demand(await head.getAttribute("aria-sort") === "descending", "the table of sets does not say how it is sorted");
  demand(isSorted(await column(), -1), "the table of sets is not sorted, largest first");
  await head.getByRole("button").click();
  demand(isSorted(await column(), 1), "the table of sets is not sorted, smallest first");
}

function isSorted(values, sign) {
  return values.every((value, index) => index === 0 || sign * (value - values[index - 1]) >= 0);
}

/** Once with the clipboard, once without it: pages opened as files may not have one. */
async function checkCopy(page, data) {
  const wanted = data.transform.rows.map((row) => row.join(" ")).join("\n");
  await page.evaluate(() => {
    window.copied = [];
    Object.defineProperty(navigator, "clipboard", { configurable: true, value: { writeText: async (text) => { window.copied.push(text); } } });
  });
  const button = page.getByRole("button", { name: "Copy the transform" });
  await button.click();
  await page.waitForFunction(() => window.copied.length === 1);
  demand((await page.evaluate(() => window.copied[0])).trim() === wanted, "the copy button copies something else than the transform");
  await page.evaluate(() => {
    Object.defineProperty(navigator, "clipboard", { configurable: true, value: undefined });
    document.addEventListener("copy", () => window.copied.push(document.activeElement.value), { once: true });
  });
  await button.click();
  await page.waitForFunction(() => window.copied.length === 2, null, { timeout: 3000 })
    .catch(() => { throw new Failure("without a clipboard the copy button does nothing"); });
  demand((await page.evaluate(() => window.copied[1])).trim() === wanted, "without a clipboard the copy button copies something else");
}

async function checkTexts(page, data) {
  const squeezed = (text) => text.replace(/\s+/g, " ").trim();
  demand(squeezed(await page.title()) === squeezed(data.title), "the page's title is not the data's");
  const shown = await page.locator("#title > span").evaluate((span) => span.getAttribute("title") ?? span.textContent);
  demand(shown === data.title, "the heading is not the title of the data");
  const wide = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
  demand(wide <= 0, `the page is ${wide} pixels wider than the window`);
}

async function checkImages(page) {
  const broken = await page.evaluate(async () => {
    const images = [...document.querySelectorAll("#views img")].filter((image) => image.getAttribute("src"));
    await Promise.all(images.map((image) => image.decode().catch(() => {})));
    return images.filter((image) => image.naturalWidth === 0).length;
  });
  demand(broken === 0, `${broken} depth maps cannot be shown`);
}

/** The page must be of use where there is no WebGL. */
async function checkWithoutGraphics(browser, file, options) {
  const context = await browser.newContext({ viewport });
  await context.addInitScript(() => {
    HTMLCanvasElement.prototype.getContext = () => null;
    console.error = () => {}; // the library reports the missing context
  });
  const page = await context.newPage();
  await page.goto(pathToFileURL(resolve(file)).href);
  await page.waitForFunction(() => document.documentElement.dataset.ready === "true", null, { timeout: options.limit * 1000 });
  demand(/WebGL/.test(await page.locator("#viewer").textContent()), "without WebGL the page does not say so");
  demand(await page.locator("#verdict .headline").count() === 1, "without WebGL the verdict is missing");
  await context.close();
}

async function checkReport(browser, file, options) {
  const { page, problems, seconds } = await open(browser, file, options);
  const data = await page.evaluate(() => JSON.parse(document.getElementById("data").textContent));
  await takeScreenshots(browser, page, file, options);
  await checkTexts(page, data);
  await checkViewer(page);
  await checkSetTable(page);
  await checkCopy(page, data);
  await checkImages(page);
  demand(problems.length === 0, problems.join("; "));
  await page.close();
  await checkWithoutGraphics(browser, file, options);
  return seconds;
}

// ---- the index of an evaluation

async function checkIndex(browser, file, options) {
  const { page, problems, seconds } = await open(browser, file, options);
  const data = await page.evaluate(() => JSON.parse(document.getElementById("data").textContent));
  await takeScreenshots(browser, page, file, options);
  await checkTexts(page, data);
  await checkWorstFirst(page, data);
  await checkSorting(page);
  await checkFilters(page, data);
  await checkLinks(page, data);
  demand(await page.locator("#recall path.curve").count() === 2 * data.methods.length, "recall curves are missing");
  demand(problems.length === 0, problems.join("; "));
  await page.close();
  return seconds;
}

async function checkWorstFirst(page, data) {
  const bad = data.pairs.filter((pair) => pair.error || pair.solved !== true).length;
  const results = await page.locator("#pairs tbody .badge").allTextContents();
  demand(results.slice(0, bad).every((text) => !/ solved$/.test(text) || /not solved/.test(text)), "failures do not come first");
}

async function checkSorting(page) {
  const head = page.locator("#pairs thead th", { hasText: "rotation" });
  await head.getByRole("button").click();
  demand(await head.getAttribute("aria-sort") === "descending", "the table of pairs does not say how it is sorted");
  const cells = await page.locator("#pairs tbody td:nth-child(5)").allTextContents();
  demand(isSorted(cells.map(Number).filter(Number.isFinite), -1), "the table of pairs is not sorted");
}

async function checkFilters(page, data) {
  const shown = async () => Number((await page.locator("#pairs [role=status]").textContent()).split(" ")[0].replaceAll(",", ""));
  await page.locator("#filter-failures").check();
  demand(await shown() === data.pairs.filter((pair) => pair.error || pair.solved !== true).length, "only failures: another number of rows");
  await page.locator("#filter-failures").uncheck();
  const [{ method, scene }] = data.pairs;
  await page.locator("#filter-method").selectOption(method);
  demand(await shown() === data.pairs.filter((pair) => pair.method === method).length, "filter by method: another number of rows");
  await page.locator("#filter-method").selectOption("");
  await page.locator("#filter-text").fill(scene.slice(0, 8));
  demand(await shown() >= data.pairs.filter((pair) => pair.scene === scene).length, "filter by text: too few rows");
  await page.locator("#filter-text").fill("no such pair anywhere");
  demand(await shown() === 0, "filter by text: rows without the text");
  await page.locator("#filter-text").fill("");
}

async function checkLinks(page, data) {
  const more = page.locator("#pairs .more");
  if (await more.isVisible()) await more.click();
  const links = await page.locator("#pairs tbody a").evaluateAll((anchors) => anchors.map((anchor) => anchor.getAttribute("href")));
  const wanted = data.pairs.map((pair) => pair.page).filter(Boolean);
  demand(links.sort().join("\n") === wanted.sort().join("\n"), "the links are not those of the data");
  const addresses = await page.locator("#pairs tbody a").evaluateAll((anchors) => anchors.map((anchor) => anchor.href));
  for (const address of addresses) demand(existsSync(fileURLToPath(address)), `the page ${address} does not exist`);
}

// ---- pictures

async function takeScreenshots(browser, page, file, options) {
  if (!options.screenshots) return;
  mkdirSync(options.screenshots, { recursive: true });
  const at = (part) => join(options.screenshots, `${basename(file, ".html")}-${part}.png`);
  await page.screenshot({ path: at("top") });
  await page.screenshot({ path: at("full"), fullPage: true });
  const viewer = page.locator("#viewer .picture");
  if (await viewer.count() > 0) await viewer.screenshot({ path: at("viewer") });
  const view = page.locator("article.view").first();
  if (await view.count() > 0) await view.screenshot({ path: at("view") });
  await chooseTheme(page, "dark");
  await page.screenshot({ path: at("dark"), fullPage: true });
  await chooseTheme(page, "light");
}

/** The page hears of the change only with its next frame. */
async function chooseTheme(page, colorScheme) {
  await page.emulateMedia({ colorScheme });
  await page.evaluate(() => new Promise((done) => { requestAnimationFrame(() => requestAnimationFrame(done)); }));
}

async function check(browser, file, options) {
  const page = await browser.newPage();
  await page.goto(pathToFileURL(resolve(file)).href, { waitUntil: "commit" });
  await page.waitForLoadState("domcontentloaded");
  const isReport = await page.locator("#viewer-section").count() > 0;
  await page.close();
  const seconds = await (isReport ? checkReport : checkIndex)(browser, file, options);
  console.log(`ok ${file}: ${isReport ? "report" : "index"}, ready after ${seconds.toFixed(1)} s`);
}

async function main() {
  const options = readArguments(process.argv.slice(2));
  const executablePath = process.env.CHROMIUM ?? "/usr/bin/chromium";
  if (!process.env.CHROMIUM && !existsSync(executablePath)) {
    console.log(`skipped: no browser at ${executablePath}; set CHROMIUM to another one`);
    return;
  }
  const browser = await chromium.launch({ executablePath, headless: true, args: browserArguments });
  try {
    for (const file of options.files) {
      await check(browser, file, options).catch((error) => { throw new Failure(`${file}: ${error.message}`); });
    }
  } finally {
    await browser.close();
  }
}

main().catch((error) => {
  console.error(`failed: ${error.message}`);
  process.exitCode = 1;
});
