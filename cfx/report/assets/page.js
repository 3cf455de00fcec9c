"use strict";
(function () {
  const PRINTED = 680; // pixels: fits A4 and Letter with the margins that page.css sets
  const options = {
    responsive: true,
    displaylogo: false,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
    toImageButtonOptions: { format: "png", scale: 2 },
  };
  const contents = new Map();

  function content(box) {
    if (!contents.has(box)) {
      const held = JSON.parse(document.getElementById(box.id + "-content").textContent);
      held.view = Object.keys(held.views)[0];
      held.order = Object.keys(held.orders)[0];
      contents.set(box, held);
    }
    return contents.get(box);
  }

  function draw(box) {
    const held = content(box);
    const view = held.views[held.view];
    if (held.order !== undefined) {
      view.layout.xaxis.categoryarray = held.orders[held.order];
    }
    document.getElementById(box.id + "-note").textContent = view.note;
    box.dataset.drawn = "yes";
    return Plotly.react(box, view.data, view.layout, options);
  }

  const boxes = Array.from(document.querySelectorAll(".plot"));
  const soon = new IntersectionObserver(
    function (entries) {
      entries.forEach(function (entry) {
        if (entry.isIntersecting) {
          soon.unobserve(entry.target);
          draw(entry.target);
        }
      });
    },
    { rootMargin: "800px" },
  );
  boxes.forEach((box) => soon.observe(box));

  document.querySelectorAll("select[data-plot]").forEach(function (choice) {
    choice.addEventListener("change", function () {
      const box = document.getElementById(choice.dataset.plot);
      content(box)[choice.dataset.choose] = choice.value;
      draw(box);
    });
  });

  // On paper every plot that is not folded away is drawn, as wide as the paper.
  const visible = () => boxes.filter((box) => box.offsetParent !== null);
  window.addEventListener("beforeprint", function () {
    visible().forEach(function (box) {
      if (!box.dataset.drawn) draw(box);
      Plotly.relayout(box, { autosize: false, width: PRINTED, height: box.clientHeight });
    });
  });
  window.addEventListener("afterprint", function () {
    visible().forEach((box) => Plotly.relayout(box, { autosize: true, width: null, height: null }));
  });

  // The contents mark the section that is being read.
  const links = new Map(Array.from(document.querySelectorAll("nav a"), (link) => [link.hash.slice(1), link]));
  const reading = new IntersectionObserver(
    function (entries) {
      entries.forEach(function (entry) {
        const link = links.get(entry.target.id);
        if (link && entry.isIntersecting) {
          links.forEach((other) => other.removeAttribute("aria-current"));
          link.setAttribute("aria-current", "true");
        }
      });
    },
    { rootMargin: "-10% 0px -80% 0px" },
  );
  links.forEach((link, id) => reading.observe(document.getElementById(id)));
})();
