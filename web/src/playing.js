// A sequence that is played in the worker: a frame is decoded and drawn, and handed over when it is due. Between two
// frames the worker hears what is wanted, so that a pause or another place of the sequence does not wait for more than one.

/** Of the time that there is for a frame, this much is for drawing it. */
const DRAWING = 0.5;
const LEAST_SCALE = 0.25;

export class Playing {
  #player;
  #attempt;
  #draw;
  #hand;
  /** What was drawn ahead of its time. */
  #waiting = null;
  /** The frame that was handed over last. */
  #shown = null;
  /** Of the pixels of the canvas along each side, so many are drawn while the sequence runs. */
  #scale = 1;
  #timer = 0;
  /** Tells the step that comes next from those that were given up. */
  #turn = 0;
  /** For what comes at once: a timer would wait for 4 ms. */
  #soon = new MessageChannel();

  /**
   * `attempt` runs what may fail, `draw` makes a picture of Gaussians with a share of the canvas' pixels along each side,
   * `hand` takes frames with their pictures, and the Gaussians with them.
   */
  constructor(player, { attempt, draw, hand }) {
    this.#player = player;
    this.#attempt = attempt;
    this.#draw = draw;
    this.#hand = hand;
    this.#soon.port1.onmessage = ({ data }) => this.#run(data);
  }

  play() {
    this.#player.play();
    this.go();
  }

  /** Stays at the frame that was made last, and shows it as accurately as it can be. */
  pause() {
    this.#player.pause();
    this.#handOver();
    this.go();
  }

  seek(time) {
    this.#player.seek(time);
    this.#drop();
    this.go();
  }

  step(by) {
    this.#handOver();
    this.#player.step(by);
    this.go();
  }

  setSpeed(speed) {
    this.#player.speed = speed;
    this.#handOver();
    this.go();
  }

  free() {
    this.#turn += 1;
    clearTimeout(this.#timer);
    this.#soon.port1.close();
    this.#drop();
    this.#player.free();
  }

  /** Goes on with the next frame. */
  go() {
    this.#later(0);
  }

  #later(milliseconds) {
    clearTimeout(this.#timer);
    const turn = ++this.#turn;
    if (milliseconds < 1) this.#soon.port2.postMessage(turn);
    else this.#timer = setTimeout(() => this.#run(turn), milliseconds);
  }

  #run(turn) {
    if (turn === this.#turn) this.#attempt(() => this.#next());
  }

  /** Hands over what is due, and makes the next frame. */
  #next() {
    this.#handOver();
    const start = performance.now();
    const frame = this.#player.next();
    if (frame === null) return this.#rest();
    if (!frame.gaussians && !frame.error) return this.#later(0);
    if (frame.gaussians) {
      frame.scale = frame.budget > 0 ? this.#scale : 1;
      frame.picture = this.#draw(frame.gaussians, frame.scale);
      this.#player.took((performance.now() - start) / 1000);
      this.#adapt(frame);
    }
    this.#waiting = frame;
    this.#later(start + 1000 * frame.due - performance.now());
  }

  /** As many pixels as there is time for. */
  #adapt({ budget, picture }) {
    if (budget <= 0) return;
    const wanted = this.#scale * Math.sqrt((1000 * DRAWING * budget) / Math.max(1, picture.milliseconds));
    this.#scale = Math.min(1, Math.max(LEAST_SCALE, wanted));
  }

  /** Where the sequence stands, its frame is shown with all pixels. */
  #rest() {
    if (!this.#shown || this.#shown.scale === 1) return;
    this.#shown.scale = 1;
    this.#hand({ ...this.#shown, picture: this.#draw(this.#shown.gaussians, 1) });
  }

  #handOver() {
    const frame = this.#waiting;
    this.#waiting = null;
    if (!frame) return;
    if (frame.gaussians) this.#shown = frame;
    this.#hand(frame);
  }

  #drop() {
    this.#waiting?.gaussians?.free();
    this.#waiting = null;
  }
}
