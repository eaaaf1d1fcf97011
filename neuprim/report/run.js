// Controls of a run's report: copy buttons, the order of the held-out views, and their comparison with the ground truth.
"use strict";
const all = (selector, inside = document) => [...inside.querySelectorAll(selector)];
const viewOf = button => document.getElementById(button.dataset.view);
const buttons = all("button[data-view]").filter(button => all("img", viewOf(button)).length === 3); // intact pictures
for (const control of [...all("button.copy, p.choose"), ...buttons]) control.hidden = false;

for (const button of all("button.copy")) {
  button.onclick = async () => {
    const code = button.previousElementSibling;
    getSelection().selectAllChildren(code);
    try {
      await navigator.clipboard.writeText(code.textContent);
    } catch { // no permission
      document.execCommand("copy");
    }
    button.textContent = "Copied";
  };
}

const order = document.getElementById("order"), views = all(".view");
if (order) order.onchange = () => {
  const psnr = view => Number(order.value) * Number(view.dataset.psnr);
  views[0].parentElement.append(...[...views].sort((a, b) => psnr(a) - psnr(b)));
};

const frame = document.querySelector(".compare");
if (frame && buttons.length) {
  const slide = frame.querySelector(".slide"), range = frame.querySelector("input");
  const divide = () => {
    slide.style.setProperty("--at", `${range.value}%`);
    range.setAttribute("aria-valuetext", `${range.value} % ground truth`);
  };
  const show = button => {
    const view = viewOf(button);
    slide.replaceChildren(...all("img", view).slice(0, 2).map(picture => picture.cloneNode()));
    frame.querySelector("figcaption").textContent = all("h3, p span", view).map(part => part.textContent).join(" · ");
    for (const other of buttons) other.setAttribute("aria-pressed", viewOf(other) === view);
  };
  for (const button of buttons) {
    button.onclick = () => {
      show(button);
      frame.scrollIntoView({ block: "nearest" });
    };
  }
  slide.onpointerdown = slide.onpointermove = event => {
    if (!event.buttons) return;
    slide.setPointerCapture(event.pointerId);
    const box = slide.getBoundingClientRect();
    range.value = 100 * (event.clientX - box.left) / box.width;
    divide();
  };
  range.oninput = divide;
  frame.hidden = false;
  divide();
  show(buttons[0]);
}
