"use strict";
(function () {
  // A choice shows one view of its figure and hides the others.
  document.querySelectorAll("select[data-plot]").forEach(function (choice) {
    const views = document.getElementById(choice.dataset.plot).querySelectorAll(".view");
    choice.addEventListener("change", function () {
      views.forEach((view, k) => (view.hidden = k !== choice.selectedIndex));
    });
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
