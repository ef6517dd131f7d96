// The drawings: the place from above, and the steering over time.

const TRAIL_POINTS = 1500;
const STEP_M = 0.03;
const SPAN_MS = 10000;

function colours() {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue(`--${name}`).trim();
}

function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

function line(context, points, close = false) {
  context.beginPath();
  points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (close) context.closePath();
  context.stroke();
}

export class PlaceMap {
  constructor(canvas) {
    this.canvas = canvas;
    this.place = { fence: [], path: [], trail: [] };
    this.car = null;
  }

  set(place) {
    this.place = { fence: place.fence, path: place.path, trail: place.trail };
  }

  move(car) {
    this.car = car;
    if (!car) return;
    const { trail } = this.place;
    const last = trail[trail.length - 1];
    if (!last || Math.hypot(last[0] - car.x_m, last[1] - car.y_m) >= STEP_M) {
      trail.push([car.x_m, car.y_m]);
      if (trail.length > TRAIL_POINTS) trail.shift();
    }
  }

  draw() {
    const { context, width, height } = prepared(this.canvas);
    const colour = colours();
    const at = this.#projection(width, height);
    const jump = (points) => {
      // A car that was put back to the start leaves no line across the room.
      let part = [];
      points.forEach((point, index) => {
        if (index && Math.hypot(point[0] - points[index - 1][0], point[1] - points[index - 1][1]) > 0.5) {
          line(context, part);
          part = [];
        }
        part.push(at(point));
      });
      line(context, part);
    };
    context.lineJoin = "round";
    context.lineWidth = 2;
    context.strokeStyle = colour("grid");
    line(context, this.place.fence.map(at), true);
    context.setLineDash([6, 5]);
    context.strokeStyle = colour("tape");
    line(context, this.place.path.map(at));
    context.setLineDash([]);
    context.lineWidth = 3;
    context.strokeStyle = colour("accent");
    jump(this.place.trail);
    if (this.car) this.#drawCar(context, at, colour);
  }

  #projection(width, height) {
    const points = [...this.place.fence, ...this.place.path, ...(this.place.fence.length ? [] : this.place.trail)];
    if (this.car && !points.length) points.push([this.car.x_m - 2, this.car.y_m - 2], [this.car.x_m + 2, this.car.y_m + 2]);
    if (!points.length) points.push([-1, -1], [1, 1]);
    const xs = points.map((point) => point[0]);
    const ys = points.map((point) => point[1]);
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const scale = Math.min((width - 24) / Math.max(right - left, 0.5), (height - 24) / Math.max(high - low, 0.5));
    const [x0, y0] = [(left + right) / 2, (low + high) / 2];
    return ([x, y]) => [width / 2 + (x - x0) * scale, height / 2 - (y - y0) * scale];
  }

  #drawCar(context, at, colour) {
    const [x, y] = at([this.car.x_m, this.car.y_m]);
    context.save();
    context.translate(x, y);
    context.rotate(-this.car.yaw_rad);
    context.fillStyle = colour("gradient");
    context.beginPath();
    context.moveTo(14, 0);
    context.lineTo(-8, 7);
    context.lineTo(-8, -7);
    context.closePath();
    context.fill();
    context.restore();
  }
}

export class SteeringPlot {
  #points = [];

  constructor(canvas) {
    this.canvas = canvas;
  }

  add(steering) {
    const now = Date.now();
    if (steering && steering.age_s < 1) this.#points.push([now, steering.clean_rad, steering.attacked_rad]);
    while (this.#points.length && now - this.#points[0][0] > SPAN_MS) this.#points.shift();
  }

  draw() {
    const { context, width, height } = prepared(this.canvas);
    const colour = colours();
    const now = Date.now();
    const largest = Math.max(0.1, ...this.#points.flatMap(([, a, b]) => [Math.abs(a ?? 0), Math.abs(b ?? 0)]));
    const at = (time, value) => [width - ((now - time) / SPAN_MS) * width, height / 2 - (value / largest) * (height / 2 - 14)];
    context.lineWidth = 1;
    context.strokeStyle = colour("grid");
    line(context, [[0, height / 2], [width, height / 2]]);
    context.fillStyle = colour("muted");
    context.font = "12px system-ui, sans-serif";
    const degrees = (largest * 180 / Math.PI).toFixed(0);
    context.fillText(`left ${degrees}°`, 2, 11);
    context.fillText(`right ${degrees}°`, 2, height - 2);
    context.lineWidth = 2;
    ["none", "gradient"].forEach((name, index) => {
      context.strokeStyle = colour(name);
      const points = this.#points.filter((point) => point[index + 1] !== null);
      line(context, points.map((point) => at(point[0], point[index + 1])));
    });
  }
}
