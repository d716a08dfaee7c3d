// From metres of the map to pixels of the canvas. x to the right, y up.

const SLACK = 0.12; // of the picture's size kept free around what is to be seen

export class MapView {
  scale = 20; // pixels a metre
  x = 0; // what is in the middle [m]
  y = 0;
  width = 1;
  height = 1;
  top = 0; // pixels at the upper edge in which buttons lie: nothing that is fitted is put there
  moved = false; // a person chose the part that is seen

  toScreen = (x, y) => [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  toMap = (px, py) => [this.x + (px - this.width / 2) / this.scale, this.y - (py - this.height / 2) / this.scale];

  // Show all of [x0, y0, x1, y1]; a picture that still holds it with room to spare is left as it is.
  fit([x0, y0, x1, y1], always = false) {
    const [left, top] = this.toScreen(x0, y1);
    const [right, bottom] = this.toScreen(x1, y0);
    const holds = left > 26 && top > Math.max(26, this.top - 1) && right < this.width - 12 && bottom < this.height - 26;
    const fills = right - left > 0.35 * this.width || bottom - top > 0.35 * this.height;
    if (holds && fills && !always) return;
    const room = 1 - 2 * SLACK;
    const height = Math.max(room * this.height - Math.max(0, this.top - SLACK * this.height), 0.4 * this.height);
    this.scale = Math.min((room * this.width) / Math.max(x1 - x0, 6), height / Math.max(y1 - y0, 6));
    this.x = (x0 + x1) / 2;
    const above = Math.max(0, this.top - SLACK * this.height); // the middle moves down by half of what is taken there
    this.y = (y0 + y1) / 2 + above / 2 / this.scale;
  }

  zoom(factor, px, py) {
    const [x, y] = this.toMap(px, py);
    this.scale = Math.min(2000, Math.max(0.5, this.scale * factor));
    const [nx, ny] = this.toMap(px, py);
    this.x += x - nx;
    this.y += y - ny;
    this.moved = true;
  }

  pan(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this.moved = true;
  }

  // The step of the grid [m]: 1, 2 or 5 times a power of ten, at least 55 pixels apart.
  step() {
    const least = 55 / this.scale;
    const power = 10 ** Math.floor(Math.log10(least));
    return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least);
  }
}
