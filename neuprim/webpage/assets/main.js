// The page itself: what a person turns, and what is drawn of it.
const page = JSON.parse(document.getElementById("page").textContent);
const element = id => document.getElementById(id), canvas = element("canvas");
const SLOW = 30; // milliseconds of a frame above which fewer pixels are drawn while something moves
const BACKGROUNDS = { model: page.background, black: [0, 0, 0], white: [1, 1, 1], grey: page.linear ? [0.2, 0.2, 0.2] : [0.5, 0.5, 0.5] };

function fault(text) {
  element("fault").textContent = text;
  element("still").hidden = !page.still;
}

const frames = framesOf(page, element("shared").textContent), look = lookout(page);
let paint = null, made = null, busy = false, again = false, drawn = 0, pictured = false, moved = 0, coarse = 1, settleLater = 0;
const conditions = controls(page, element("conditions"), () => {
  leave();
  request(true);
});

// What is seen is no held-out view any more.
function leave() {
  element("truth").hidden = true;
  element("views").value = "";
}

function view() {
  const far = look.now.distance, plane = far * +element("plane").value;
  const range = [Math.max(far - page.radius, 1e-6 * page.radius), far + page.radius];
  return { mode: element("mode").value, plane, range, top: page.top, background: BACKGROUNDS[element("background").value] };
}

// Draws soon; `moving` says that more is likely to come.
function request(moving = false) {
  if (moving) {
    moved = performance.now();
    clearTimeout(settleLater);
    settleLater = setTimeout(() => {
      if (coarse > 1) {
        coarse = 1;
        request();
      }
    }, 250);
  }
  if (!paint) return;
  if (busy) {
    again = true;
    return;
  }
  busy = true;
  const scale = devicePixelRatio / (element("pixels").value === "auto" ? coarse : +element("pixels").value);
  const width = Math.max(1, Math.round(innerWidth * scale)), height = Math.max(1, Math.round(innerHeight * scale)), start = performance.now();
  const bar = element("bar").getBoundingClientRect(), camera = look.camera(width, height, (innerHeight - bar.top) * (height / innerHeight));
  frames.prepared(camera, conditions.values()).then(frame => requestAnimationFrame(() => {
    const { count } = frame;
    if (paint.gl.isContextLost()) return void (busy = false);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    paint.draw(frame, view());
    paint.show(frame, view());
    drawn++;
    if (pictured) { // what is on a canvas is gone once it was shown
      pictured = false;
      canvas.toBlob(blob => Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: `${page.name}.png` }).click());
    }
    const { gl } = paint, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    (function wait() {
      const state = gl.clientWaitSync(fence, 0, 0);
      if (state === gl.TIMEOUT_EXPIRED) return void setTimeout(wait, 1);
      gl.deleteSync(fence);
      const spent = performance.now() - start;
      if (performance.now() - moved < 250) coarse = spent > SLOW ? Math.min(2 * coarse, 8) : spent < SLOW / 4 ? Math.max(coarse / 2, 1) : coarse;
      const size = `${width} × ${height}`, exactness = paint.exact ? "" : ", in 16-bit floats";
      element("info").textContent = `${count.toLocaleString("en")} of ${page.count.toLocaleString("en")} primitives, ${size}, prepared in ${frame.milliseconds.toFixed(1)} ms${exactness}`;
      busy = false;
      if (again) {
        again = false;
        request();
      }
    })();
  }));
}

// ---------------------------------------------------------------- what a person turns
function home() {
  look.at(page.home);
  element("fov").value = 0;
  leave();
}
function goTo(index) {
  const chosen = page.views[index];
  if (!chosen) return;
  look.at(chosen.camera);
  element("views").value = index;
  conditions.set(chosen.conditions);
  element("fov").value = 0;
  element("truth").hidden = !chosen.truth;
  if (chosen.truth) {
    element("truthImage").src = chosen.truth;
    element("truthName").textContent = `ground truth of ${chosen.name}`;
  }
  request();
}
element("views").append(...page.views.map((one, index) => new Option(one.name, index)));
element("views").parentElement.hidden = page.views.length === 0;
element("views").onchange = () => goTo(+element("views").value);
element("mode").onchange = () => {
  element("planeBox").hidden = element("mode").value !== "SLICE";
  request();
};
element("plane").oninput = () => request(true);
element("fov").oninput = () => {
  look.now.zoom = 4 ** +element("fov").value;
  request(true);
};
element("background").onchange = element("pixels").onchange = () => request();
element("home").onclick = () => {
  home();
  request();
};
element("picture").onclick = () => {
  pictured = true;
  request();
};
addEventListener("resize", () => request());

const fingers = new Map();
canvas.onpointerdown = event => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.onpointerup = canvas.onpointercancel = event => fingers.delete(event.pointerId);
canvas.oncontextmenu = event => event.preventDefault();
canvas.onpointermove = event => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const dx = event.clientX - before[0], dy = event.clientY - before[1], other = [...fingers].find(([id]) => id !== event.pointerId);
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  if (other) { // two fingers: pinch and pan
    const gap = (x, y) => Math.max(1, Math.hypot(x - other[1][0], y - other[1][1]));
    look.pan(dx / innerHeight / 2, dy / innerHeight / 2);
    look.nearer(gap(...before) / gap(event.clientX, event.clientY));
  } else if (event.shiftKey || event.buttons & 6) look.pan(dx / innerHeight, dy / innerHeight);
  else look.turn(-0.008 * dx, -0.008 * dy);
  leave();
  request(true);
};
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  look.nearer(Math.exp(0.001 * event.deltaY));
  request(true);
}, { passive: false });
addEventListener("keydown", event => {
  const step = { ArrowLeft: [0.05, 0], ArrowRight: [-0.05, 0], ArrowUp: [0, 0.05], ArrowDown: [0, -0.05] }[event.key];
  if (!step || event.target !== document.body) return;
  look.turn(...step);
  request(true);
});

// ---------------------------------------------------------------- begin, and begin again after the card was taken away
function begin() {
  paint = painter(canvas, page, made);
  frames.drawnBy(paint, made);
  request();
}
canvas.addEventListener("webglcontextlost", event => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => {
  busy = again = false;
  begin();
});
home();
if (page.views.length) goTo(0);
frames.ready.then(found => {
  made = found;
  begin();
}).catch(error => fault(error.message));
