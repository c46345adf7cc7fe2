// Bundles the page into one file: dist/index.html, with script, style and licences inline.
import {existsSync, mkdirSync, readFileSync, writeFileSync} from 'node:fs';
import {gzipSync} from 'node:zlib';
import * as esbuild from 'esbuild';

const here = new URL('.', import.meta.url).pathname;
const largest = 300_000; // bytes, gzipped

// The server sends every mesh as binary STL, so the loader of COLLADA files is left out.
const noCollada = {
  name: 'no-collada',
  setup(build) {
    build.onResolve({filter: /ColladaLoader\.js$/}, () => ({path: 'collada', namespace: 'none'}));
    build.onLoad({filter: /.*/, namespace: 'none'}, () => ({contents: 'export class ColladaLoader {}'}));
  },
};

const bundled = await esbuild.build({
  entryPoints: [`${here}src/main.ts`],
  bundle: true,
  minify: true,
  write: false,
  outdir: `${here}dist`,
  format: 'iife',
  target: 'es2022',
  legalComments: 'none',
  loader: {'.css': 'css'},
  plugins: [noCollada],
});
const part = (end) => bundled.outputFiles.find((file) => file.path.endsWith(end)).text;

const parts = Object.keys(JSON.parse(readFileSync(`${here}package.json`, 'utf8')).dependencies);
const licences = parts
  .map((name) => {
    const folder = `${here}node_modules/${name}/`;
    const {version, license} = JSON.parse(readFileSync(`${folder}package.json`, 'utf8'));
    // urdf-loader has its notice in its README, and the text of Apache-2.0 is this project's own.
    const text = existsSync(`${folder}LICENSE`)
      ? readFileSync(`${folder}LICENSE`, 'utf8')
      : readFileSync(`${folder}README.md`, 'utf8').split('# LICENSE')[1] +
        '\n\n' +
        readFileSync(`${here}../LICENSE`, 'utf8');
    return `${name} ${version} (${license})\n\n${text.trim()}`;
  })
  .join('\n\n\n');

const escaped = (text) => text.replace(/&/g, '&amp;').replace(/</g, '&lt;');
const page = readFileSync(`${here}src/index.html`, 'utf8')
  .replace('/*style*/', () => part('.css').trim())
  .replace('<!--licences-->', () => escaped(licences))
  .replace('/*script*/', () =>
    part('.js')
      .trim()
      .replace(/<\/script/g, '<\\/script'),
  );
mkdirSync(`${here}dist`, {recursive: true});
writeFileSync(`${here}dist/index.html`, page);

const size = gzipSync(page, {level: 9}).length;
console.log(`dist/index.html: ${page.length} bytes, ${size} gzipped`);
if (size > largest) {
  console.error(`error: the page has ${size} bytes gzipped (limit ${largest})`);
  process.exit(1);
}
