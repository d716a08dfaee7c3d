// Point clouds on a canvas in parallel projection. Several pictures share one view: drag to turn, wheel to zoom.

const TILT = 1.5; // [rad] largest tilt from the vertical

export const newEye = () => ({ yaw: Math.PI / 2, tilt: 0.95, scale: 12, x: 0, y: 0 });

// Decodes the block of `binary_payload` (`app/dashboard/payload.py`): its header with the arrays by name.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const types = { "<i2": Int16Array, "<i4": Int32Array, "<f4": Float32Array };
  const arrays = Object.fromEntries(header.arrays.map(({ name, type, shape, at }) =>
    [name, new types[type](buffer, 4 + length + at, shape.reduce((product, n) => product * n, 1))]));
  return { ...header, arrays };
}

export class PointPicture {
  constructor(canvas, eye, moved) {
    Object.assign(this, { canvas, eye });
    let held = null;
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); held = [event.offsetX, event.offsetY]; });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      const [dx, dy] = [event.offsetX - held[0], event.offsetY - held[1]];
      held = [event.offsetX, event.offsetY];
      if (event.shiftKey || event.buttons === 2) { eye.x += dx; eye.y += dy; } else {
        eye.yaw += 0.008 * dx;
        eye.tilt = Math.min(TILT, Math.max(0, eye.tilt - 0.008 * dy));
      }
      moved();
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { held = null; });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      eye.scale = Math.min(400, Math.max(2, eye.scale * Math.exp(-event.deltaY * 0.0015)));
      moved();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      const zoom = { "+": 1.2, "-": 1 / 1.2 }[event.key];
      if (!turn && !zoom) return;
      event.preventDefault();
      event.stopPropagation();
      if (turn) { eye.yaw += turn[0]; eye.tilt = Math.min(TILT, Math.max(0, eye.tilt + turn[1])); } else eye.scale *= zoom;
      moved();
    });
  }

  begin() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(devicePixelRatio, 2);
    const [w, h] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
    if (this.canvas.width !== w || this.canvas.height !== h) Object.assign(this.canvas, { width: w, height: h });
    this.pen = this.canvas.getContext("2d");
    this.pen.clearRect(0, 0, w, h);
    const { yaw, tilt, scale, x, y } = this.eye;
    const [c, s, ct, st] = [Math.cos(yaw), Math.sin(yaw), Math.cos(tilt), Math.sin(tilt)];
    const k = scale * ratio;
    this.image = this.pen.getImageData(0, 0, w, h);
    Object.assign(this, { w, h, ratio });
    this.toScreen = (px, py, pz) => [w / 2 + x * ratio + k * (c * px - s * py), h / 2 + y * ratio - k * (ct * (s * px + c * py) + st * pz)];
    return this;
  }

  // Points [cm]; `colourOf(k)` gives 0xAABBGGRR of the k-th, 0 leaves it out.
  points(points, colourOf, size = 1) {
    const { w, h, ratio, toScreen } = this;
    const pixels = new Uint32Array(this.image.data.buffer);
    const wide = Math.max(1, Math.round(size * ratio));
    for (let k = 0; 3 * k < points.length; k += 1) {
      const colour = colourOf(k);
      if (!colour) continue;
      const [sx, sy] = toScreen(points[3 * k] / 100, points[3 * k + 1] / 100, points[3 * k + 2] / 100);
      const [ix, iy] = [Math.floor(sx), Math.floor(sy)];
      if (ix < 0 || iy < 0 || ix + wide > w || iy + wide > h) continue;
      for (let dy = 0; dy < wide; dy += 1) pixels.fill(colour, (iy + dy) * w + ix, (iy + dy) * w + ix + wide);
    }
    return this;
  }

  end() {
    this.pen.putImageData(this.image, 0, 0);
    return this;
  }

  // A fitted circle [m], at its cluster's height.
  ring(x, y, radius, z, colour) {
    const { pen, ratio, toScreen } = this;
    pen.beginPath();
    for (let turn = 0; turn <= 24; turn += 1) pen.lineTo(...toScreen(x + radius * Math.cos((turn * Math.PI) / 12), y + radius * Math.sin((turn * Math.PI) / 12), z));
    Object.assign(pen, { strokeStyle: colour, lineWidth: 1.6 * ratio });
    pen.stroke();
  }

  // Where the sensor stands, pointing ahead.
  robot(colour) {
    const { pen, toScreen } = this;
    pen.beginPath();
    for (const [x, y] of [[0.7, 0], [-0.5, 0.4], [-0.5, -0.4]]) pen.lineTo(...toScreen(x, y, 0));
    pen.closePath();
    pen.fillStyle = colour;
    pen.fill();
  }

  letter(x, y, z, text, colour, back) {
    const { pen, ratio, toScreen } = this;
    const [sx, sy] = toScreen(x, y, z);
    Object.assign(pen, { font: `600 ${11 * ratio}px sans-serif`, textAlign: "center", strokeStyle: back, fillStyle: colour, lineWidth: 3 * ratio });
    pen.strokeText(text, sx, sy - 6 * ratio);
    pen.fillText(text, sx, sy - 6 * ratio);
  }
}

// "#rrggbb" as a pixel of an ImageData.
export function pixel(hex) {
  const n = parseInt(hex.slice(1), 16);
  return (0xff000000 | ((n & 255) << 16) | (n & 0xff00) | (n >> 16)) >>> 0;
}
