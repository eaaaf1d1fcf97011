// A control for every condition of the model: a slider and a play button for a number, a pad for a place, boxes for other numbers.
function controls(page, into, changed) {
  const values = {}, setters = {};
  const make = (tag, properties, ...children) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  };

  function slider({ name, range, value, period, frames }) {
    const [low, high] = range, out = make("output", {});
    const bar = make("input", { type: "range", min: low, max: high, step: (high - low) / 1000, ariaLabel: name });
    const play = make("button", { textContent: "▶", title: `play ${name}`, ariaLabel: `play ${name}` });
    let since = null;
    const set = x => {
      values[name] = x;
      bar.value = x;
      const part = (x - low) / (high - low);
      out.textContent = frames ? `frame ${Math.round(frames[0] + part * (frames[1] - frames[0]))}` : x.toFixed(2);
    };
    const step = now => {
      if (since === null) return;
      set(low + ((now - since) / (1000 * period)) % 1 * (high - low));
      changed();
      requestAnimationFrame(step);
    };
    bar.oninput = () => {
      since = null;
      play.textContent = "▶";
      set(+bar.value);
      changed();
    };
    play.onclick = () => {
      const going = since !== null;
      since = going ? null : performance.now() - ((values[name] - low) / (high - low)) * 1000 * period;
      play.textContent = going ? "▶" : "❚❚";
      if (!going) requestAnimationFrame(step);
    };
    setters[name] = set;
    set(value);
    into.append(make("label", { className: "condition" }, name, play, bar, out));
  }

  function pad({ name, value }) { // azimuth across, elevation upwards, and the distance from the middle of everything
    const up = lib.unit([...page.up]), helper = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], side = lib.unit(lib.cross(up, helper)), front = lib.cross(up, side);
    const knob = make("i", {}), field = make("div", { className: "pad", title: `drag: where ${name} is`, tabIndex: 0, role: "slider", ariaLabel: name }, knob);
    const far = make("input", { type: "range", min: -1, max: 1, step: 0.01, ariaLabel: `distance of ${name}`, title: "distance" });
    let usual = 1, azimuth = 0, elevation = 0;
    const place = () => {
      const r = usual * 4 ** +far.value, level = r * Math.cos(elevation);
      values[name] = page.center.map((c, a) => c + level * (Math.cos(azimuth) * side[a] + Math.sin(azimuth) * front[a]) + r * Math.sin(elevation) * up[a]);
      show();
    };
    const show = () => {
      knob.style.left = `${50 + (50 * azimuth) / Math.PI}%`;
      knob.style.top = `${50 - (100 * elevation) / Math.PI}%`;
    };
    setters[name] = place3 => {
      const away = place3.map((x, a) => x - page.center[a]);
      usual = Math.max(Math.hypot(...away), 1e-9);
      azimuth = Math.atan2(lib.dot(away, front), lib.dot(away, side));
      elevation = Math.asin(Math.min(Math.max(lib.dot(away, up) / usual, -1), 1));
      far.value = 0;
      values[name] = [...place3];
      show();
    };
    const limit = (x, most) => Math.min(Math.max(x, -most), most);
    const move = event => {
      const box = field.getBoundingClientRect();
      azimuth = limit(((event.clientX - box.left) / box.width - 0.5) * 2 * Math.PI, Math.PI);
      elevation = limit((0.5 - (event.clientY - box.top) / box.height) * Math.PI, Math.PI / 2);
      place();
      changed();
    };
    field.onpointerdown = event => {
      field.setPointerCapture(event.pointerId);
      field.onpointermove = move;
      move(event);
    };
    field.onpointerup = field.onpointercancel = () => (field.onpointermove = null);
    field.onkeydown = event => {
      const step = { ArrowLeft: [-0.05, 0], ArrowRight: [0.05, 0], ArrowUp: [0, 0.05], ArrowDown: [0, -0.05] }[event.key];
      if (!step) return;
      azimuth = limit(azimuth + step[0], Math.PI);
      elevation = limit(elevation + step[1], Math.PI / 2);
      place();
      changed();
      event.preventDefault();
      event.stopPropagation();
    };
    far.oninput = () => {
      place();
      changed();
    };
    setters[name](value);
    into.append(make("label", { className: "condition" }, name, field, far));
  }

  function boxes({ name, value, range }) {
    const inputs = value.map((x, a) => make("input", { type: "number", min: range[0], max: range[1], step: "any", ariaLabel: `${name} ${a + 1}` }));
    setters[name] = several => {
      values[name] = [...several];
      inputs.forEach((input, a) => (input.value = +several[a].toPrecision(4)));
    };
    inputs.forEach((input, a) => {
      input.onchange = () => {
        if (!Number.isFinite(input.valueAsNumber)) return setters[name](values[name]);
        values[name][a] = Math.min(Math.max(input.valueAsNumber, range[0]), range[1]);
        changed();
      };
    });
    setters[name](value);
    into.append(make("label", { className: "condition" }, name, ...inputs));
  }

  for (const condition of page.conditions) {
    if (!Array.isArray(condition.value)) slider(condition);
    else if (condition.place) pad(condition);
    else boxes(condition);
  }
  return {
    values: () => structuredClone(values),
    set(given) {
      for (const [name, value] of Object.entries(given)) if (setters[name]) setters[name](value);
    },
  };
}
