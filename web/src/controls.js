// The controls of a sequence: a button, a time line and a speed.

export class Controls {
  #viewer;
  #form = document.getElementById("player");
  #toggle = document.getElementById("toggle");
  #when = document.getElementById("when");
  #clock = document.getElementById("clock");
  #speed = document.getElementById("speed");
  #seconds = 0;
  /** Whether the time line is held: frames that come meanwhile do not move it. */
  #held = false;

  /** They show themselves, and play, when the viewer has opened a sequence. */
  constructor(viewer) {
    this.#viewer = viewer;
    viewer.addEventListener("sequence", ({ detail }) => this.#show(detail));
    viewer.addEventListener("frame", ({ detail }) => this.#frame(detail));
    viewer.addEventListener("failure", () => this.#say());
    this.#toggle.addEventListener("click", () => this.#play(!viewer.playing));
    this.#speed.addEventListener("change", () => (viewer.speed = Number(this.#speed.value)));
    this.#when.addEventListener("input", () => viewer.seek(Number(this.#when.value)));
    this.#when.addEventListener("pointerdown", () => (this.#held = true));
    for (const name of ["pointerup", "pointercancel"]) {
      this.#when.addEventListener(name, () => (this.#held = false));
    }
  }

  hide() {
    this.#form.hidden = true;
  }

  /** Space plays and pauses, the arrows go to the next frame and to the one before. */
  press({ key }) {
    if (this.#form.hidden) return;
    if (key === " ") this.#play(!this.#viewer.playing);
    const by = { ArrowRight: 1, ArrowLeft: -1 }[key];
    if (by) this.#viewer.step(by);
    this.#say();
  }

  #show({ seconds }) {
    this.#seconds = seconds;
    this.#when.max = seconds;
    this.#form.hidden = false;
    this.#viewer.speed = Number(this.#speed.value);
    this.#play(true);
  }

  #play(on) {
    if (on) this.#viewer.play();
    else this.#viewer.pause();
    this.#say();
  }

  #say() {
    const { playing } = this.#viewer;
    this.#toggle.textContent = playing ? "❚❚" : "▶";
    this.#toggle.ariaLabel = playing ? "pause" : "play";
  }

  #frame({ time }) {
    if (!this.#held) this.#when.value = time;
    this.#clock.value = `${time.toFixed(2)} / ${this.#seconds.toFixed(2)} s`;
  }
}
