"use strict";
(function () {
  const content = JSON.parse(document.getElementById("content").textContent);
  const find = (id) => document.getElementById(id);
  const [canvas, chooser, slider, button, clock, rate, state, plot] = ["road", "pair", "time", "play", "clock", "rate", "state", "plot"].map(find);
  const pen = canvas.getContext("2d");
  const CAR_WIDTH = 1.9; // m
  const LEAD_IN = 3; // seconds of the recording that are shown before the models take over
  const VIEW = { centre: [0, 0], forward: [1, 0], scale: 6, width: 0, height: 0 };
  let pair = content.pairs[0];
  let frame = 0; // may lie between two frames while it plays
  let playing = false;
  let before = 0;

  const lanes = content.lanes.map((lane) => ({ width: lane.width, inner: lane.inner, shape: lane.shape.map((p) => [p[0] / 100, p[1] / 100]) }));
  const last = (one) => one.speed.real.length - 1;

  // A vehicle at a moment between two frames: x, y in metres, heading in radians.
  function at(one, kind, which, moment) {
    const low = Math.min(Math.floor(moment), last(one));
    const high = Math.min(low + 1, last(one));
    const share = Math.min(moment, last(one)) - low;
    const a = one.place[kind][low][which], b = one.place[kind][high][which];
    const mix = (k) => a[k] + share * (b[k] - a[k]);
    const turn = ((b[2] - a[2] + 5400) % 3600) - 1800; // the short way round
    return { x: mix(0) / 100, y: mix(1) / 100, heading: ((a[2] + share * turn) / 10) * (Math.PI / 180) };
  }

  function value(series, moment) {
    return series[Math.min(Math.round(moment), series.length - 1)] / 100;
  }

  function toScreen(x, y) {
    const dx = x - VIEW.centre[0], dy = y - VIEW.centre[1];
    const along = dx * VIEW.forward[0] + dy * VIEW.forward[1];
    const left = -dx * VIEW.forward[1] + dy * VIEW.forward[0];
    return [VIEW.width / 2 + VIEW.scale * along, VIEW.height / 2 - VIEW.scale * left];
  }

  function look() {
    const leader = at(pair, "real", 0, frame);
    const behind = content.followers.map((kind) => at(pair, kind, 1, frame));
    const forward = [Math.sin(leader.heading), Math.cos(leader.heading)];
    const reach = behind.map((car) => (leader.x - car.x) * forward[0] + (leader.y - car.y) * forward[1]);
    const middle = content.followers.map((kind) => at(pair, kind, 0, frame));
    const x = middle.reduce((sum, car) => sum + car.x, 0) / middle.length, y = middle.reduce((sum, car) => sum + car.y, 0) / middle.length;
    VIEW.forward = forward;
    VIEW.centre = [x - (forward[0] * Math.max(...reach)) / 2, y - (forward[1] * Math.max(...reach)) / 2];
    VIEW.scale = Math.min(10, VIEW.height / 27, (0.84 * VIEW.width) / (pair.span + 12));
  }

  function trace(points) {
    pen.beginPath();
    points.forEach((point, k) => (k ? pen.lineTo(...toScreen(...point)) : pen.moveTo(...toScreen(...point))));
    pen.stroke();
  }

  function aside(shape, distance) {
    return shape.map(function (point, k) {
      const a = shape[Math.max(0, k - 1)], b = shape[Math.min(shape.length - 1, k + 1)];
      const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
      return [point[0] - ((b[1] - a[1]) / length) * distance, point[1] + ((b[0] - a[0]) / length) * distance];
    });
  }
  lanes.forEach((lane) => (lane.border = aside(lane.shape, lane.width / 2)));

  function drawRoad() {
    pen.lineCap = "butt";
    pen.lineJoin = "round";
    [[0.5, "#f4f4f4"], [0.02, "#6b7178"]].forEach(function ([grow, colour]) {
      pen.strokeStyle = colour;
      lanes.forEach(function (lane) {
        pen.lineWidth = (lane.width + grow) * VIEW.scale;
        trace(lane.shape);
      });
    });
    pen.strokeStyle = "#f4f4f4";
    pen.lineWidth = Math.max(1, 0.15 * VIEW.scale);
    pen.setLineDash([3 * VIEW.scale, 9 * VIEW.scale]);
    lanes.filter((lane) => lane.inner).forEach((lane) => trace(lane.border));
    pen.setLineDash([]);
  }

  function drawCar(car, length, colour, strong) {
    const [x, y] = toScreen(car.x, car.y);
    const own = Math.atan2(VIEW.forward[0], VIEW.forward[1]);
    pen.save();
    pen.translate(x, y);
    pen.rotate(car.heading - own);
    pen.globalAlpha = strong ? 1 : 0.55;
    pen.fillStyle = colour;
    pen.strokeStyle = "white";
    pen.lineWidth = 1;
    pen.beginPath();
    pen.roundRect(-length * VIEW.scale, (-CAR_WIDTH / 2) * VIEW.scale, length * VIEW.scale, CAR_WIDTH * VIEW.scale, 0.5 * VIEW.scale);
    pen.fill();
    pen.stroke();
    pen.fillStyle = "rgba(255,255,255,0.75)"; // the windscreen
    pen.fillRect(-0.42 * length * VIEW.scale, (-0.38 * CAR_WIDTH) * VIEW.scale, 0.14 * length * VIEW.scale, 0.76 * CAR_WIDTH * VIEW.scale);
    pen.restore();
  }

  function drawPair(one, strong) {
    if (frame > last(one)) return;
    content.followers.forEach(function (kind) {
      const leader = at(one, kind, 0, frame), follower = at(one, kind, 1, frame);
      const rear = { x: leader.x - Math.sin(leader.heading) * one.leaderLength, y: leader.y - Math.cos(leader.heading) * one.leaderLength };
      if (strong) {
        pen.strokeStyle = content.colours[kind];
        pen.lineWidth = 2;
        trace([[follower.x, follower.y], [rear.x, rear.y]]);
      }
      drawCar(leader, one.leaderLength, content.colours.leader, strong);
      drawCar(follower, content.carLength, content.colours[kind], strong);
      if (strong) {
        const tail = toScreen(follower.x - Math.sin(follower.heading) * content.carLength, follower.y - Math.cos(follower.heading) * content.carLength);
        const text = value(one.gap[kind], frame).toFixed(1) + " m, " + value(one.speed[kind], frame).toFixed(1) + " m/s";
        pen.font = "600 13px system-ui, sans-serif";
        const width = pen.measureText(text).width + 10;
        const left = Math.max(4, tail[0] - width - 6);
        pen.fillStyle = "rgba(255,255,255,0.88)";
        pen.fillRect(left, tail[1] - 9, width, 18);
        pen.fillStyle = content.colours[kind];
        pen.textBaseline = "middle";
        pen.fillText(text, left + 5, tail[1] + 0.5);
      }
    });
  }

  // A line in each panel at the moment that the road shows.
  function drawCursor() {
    const seconds = frame * pair.dt;
    const lines = plot.querySelectorAll(".now");
    pair.axes.forEach(function ([left, top, width, height, begin, end], k) {
      const inside = (seconds - begin) / (end - begin);
      lines[k].hidden = inside < 0 || inside > 1;
      lines[k].style.left = 100 * (left + inside * width) + "%";
      lines[k].style.top = 100 * top + "%";
      lines[k].style.height = 100 * height + "%";
    });
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    VIEW.width = canvas.clientWidth;
    VIEW.height = canvas.clientHeight;
    if (canvas.width !== Math.round(VIEW.width * ratio) || canvas.height !== Math.round(VIEW.height * ratio)) {
      canvas.width = Math.round(VIEW.width * ratio);
      canvas.height = Math.round(VIEW.height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, VIEW.width, VIEW.height);
    look();
    drawRoad();
    content.pairs.filter((one) => one.scene === pair.scene && one !== pair).forEach((one) => drawPair(one, false));
    drawPair(pair, true);
    drawCursor();
    slider.value = String(Math.round(frame));
    clock.textContent = (frame * pair.dt).toFixed(1) + " s of " + (last(pair) * pair.dt).toFixed(1) + " s";
    const away = (pair.first - frame) * pair.dt;
    state.textContent = away > 0 ? "all three are the recording; the models take over in " + away.toFixed(1) + " s" : "the models have taken over";
  }

  function choose(number) {
    pair = content.pairs[number];
    const reach = content.followers.map((kind) => Math.max(...pair.gap[kind].slice(pair.first)) / 100);
    pair.span = Math.max(...reach) + pair.leaderLength + content.carLength;
    slider.max = String(last(pair));
    frame = Math.max(0, pair.first - LEAD_IN / pair.dt);
    plot.querySelectorAll(".view").forEach((view, k) => (view.hidden = k !== number));
    plot.querySelectorAll(".now").forEach((line) => line.remove());
    pair.axes.forEach(function () {
      const line = document.createElement("div");
      line.className = "now";
      plot.appendChild(line);
    });
    draw();
  }

  function play(wanted) {
    playing = wanted;
    button.textContent = playing ? "Pause" : "Play";
    button.setAttribute("aria-pressed", String(playing));
    if (!playing) return;
    if (frame >= last(pair)) frame = Math.max(0, pair.first - LEAD_IN / pair.dt);
    before = performance.now();
    requestAnimationFrame(tick);
  }

  function tick(now) {
    if (!playing) return;
    const passed = Math.max(0, now - before); // a frame's time may lie before the click that started it
    frame = Math.min(last(pair), frame + (passed / 1000) * (Number(rate.value) / pair.dt));
    before = now;
    draw();
    if (frame >= last(pair)) play(false);
    else requestAnimationFrame(tick);
  }

  chooser.addEventListener("change", () => choose(Number(chooser.value)));
  slider.addEventListener("input", function () {
    play(false);
    frame = Number(slider.value);
    draw();
  });
  button.addEventListener("click", () => play(!playing));
  window.addEventListener("resize", draw);
  choose(0);
  if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) play(true);
})();
