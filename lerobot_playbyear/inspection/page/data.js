// What the page was given: the dataset's head, and for each episode its drawings and its film, decoded when shown.

const byId = (id) => document.getElementById(id);

function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

const dataset = JSON.parse(byId("dataset").textContent);
const fps = dataset.facts.fps;
const shortName = (key) => key.split(".").slice(key.startsWith("observation.") ? 2 : 0).join(".") || key.replace("observation.", "");

function filmOf(position) {
  return URL.createObjectURL(new Blob([bytesOf(byId(`film-${position}`).textContent)], { type: "video/mp4" }));
}

async function episodeOf(position) {
  const data = JSON.parse(byId(`episode-${position}`).textContent);
  const head = dataset.episodes[position];
  const microphones = await Promise.all(
    data.microphones.map(async (sound, i) => ({
      ...dataset.microphones[i],
      hop: sound.hop,
      onsets: sound.onsets,
      wave: new Int8Array(bytesOf(sound.wave).buffer),
      levels: await greyOf(sound.spectrogram),
    })),
  );
  const curves = data.curves.map((values, i) => ({ ...dataset.curves[i], values: new Float32Array(bytesOf(values).buffer) }));
  return { ...head, position, microphones, curves, interventions: data.interventions, duration: head.frames / fps };
}

// The grey levels of a picture: {width, height, data}, one byte per pixel.
async function greyOf(png) {
  const image = new Image();
  image.src = `data:image/png;base64,${png}`;
  await image.decode();
  const canvas = make("canvas", { width: image.width, height: image.height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const rgba = context.getImageData(0, 0, image.width, image.height).data;
  const data = new Uint8Array(image.width * image.height);
  for (let i = 0; i < data.length; i++) data[i] = rgba[4 * i];
  return { width: image.width, height: image.height, data };
}
