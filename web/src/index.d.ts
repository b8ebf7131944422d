/** A colour, red, green and blue in [0, 1]. */
export type Colour = [number, number, number];
export type Heads = "best" | "quick" | "surfels";

/** What a stream or an argument is refused for. */
export class B2pError extends Error {
  readonly kind:
    | "io" | "truncated" | "checksum" | "model" | "determinism" | "limit" | "unsupported" | "malformed" | "cancelled"
    | "usage" | "internal";
}

export interface DecodeOptions {
  /** The level to end with; the finest if it is left out. */
  level?: number;
  /** Learned heads. */
  model?: HeadsModel | null;
  heads?: Heads | null;
}

/** The library, in the thread that loads it. After an `internal` error it must not be used any more. */
export class B2p {
  static load(
    source: Response | Promise<Response> | BufferSource | WebAssembly.Module,
    options?: {
      report?: (line: string) => void;
      /** How many threads a module with threads gets; one per core, 16 at most, if it is left out. */
      threads?: number | null;
      /** Name of the `BroadcastChannel` that tells of a thread that failed, for which the library would wait for ever. */
      channel?: string;
    },
  ): Promise<B2p>;
  /** Ends its threads, if it has any. It must not be used any more. */
  close(): void;
  readonly version: string;
  headsModel(bytes: Uint8Array | ArrayBuffer): HeadsModel;
  decoding(options?: DecodeOptions): Decoding;
  decode(bytes: Uint8Array | ArrayBuffer, options?: DecodeOptions): Gaussians;
  /** What a file holds by its first 4096 bytes, or all of them. What is none of these is refused, and named. */
  content(bytes: Uint8Array | ArrayBuffer): Content;
  /** A sequence, whole or in parts. It stands at its first frame. */
  player(bytes: Uint8Array | ArrayBuffer | Uint8Array[], options?: DecodeOptions): Player;
  /** Gaussians in a PLY, SPZ, SOG, .splat, glTF, CSV or NumPy file: its bytes, whole or in parts. */
  splats(bytes: Uint8Array | ArrayBuffer | Uint8Array[]): Gaussians;
}

/** A sequence that is played by the clock: a frame at each call of `next`, which is shown when it is due. */
export interface Player extends Handle {
  info(): SequenceInfo;
  play(): void;
  /** Stays at the frame that was made last, which is then decoded as accurately as it can be. */
  pause(): void;
  seek(seconds: number): void;
  /** Pauses so many frames further on, or back. */
  step(by: number): void;
  /** From ⅛ to 8. */
  set speed(speed: number);
  /** `null`: there is nothing to do until something else is wanted. */
  next(): PlayedFrame | null;
  /** How long the last frame took, decoded and drawn: levels and heads are chosen by that. */
  took(seconds: number): void;
}

export interface SequenceInfo {
  seconds: number;
  frames: number;
  /** The coarsest and the finest level that can be drawn. */
  base: number;
  top: number;
}

export interface PlayedFrame {
  number: number;
  /** Its time in the sequence, in seconds. */
  time: number;
  /** Seconds from the call on until it is to be shown. */
  due: number;
  /** Seconds that there are for a frame; 0 if the clock stands. */
  budget: number;
  /** Frames that were due and not shown. */
  dropped: number;
  level: number;
  heads: Heads;
  /** `null` if it is not to be shown. */
  gaussians: Gaussians | null;
  /** Why it is skipped with those that are predicted from it. */
  error: B2pError | null;
}

export type Content = "stream" | "scene" | "sequence" | "splats";

/** Memory of the library: it is given back by `free`, once. */
interface Handle {
  free(): void;
}

export interface HeadsModel extends Handle {}

/** A stream that is decoded as its bytes arrive. */
export interface Decoding extends Handle {
  push(bytes: Uint8Array | ArrayBuffer): void;
  /** Decodes the next level if all of it has come. To be called until it is `null`. */
  advance(): number | null;
  finish(): void;
  readonly level: number | null;
  gaussians(): Gaussians;
  points(): Points;
}

/** Voxels of a level. One with coordinates `c` covers `origin + c · voxelSize` to `origin + (c + 1) · voxelSize`. */
export interface Points {
  count: number;
  level: number;
  origin: [number, number, number];
  voxelSize: number;
  /** x, y, z of each. */
  coordinates: Uint32Array;
  /** Red, green, blue of each. */
  colours: Uint8Array;
}

/** Gaussians in the cube frame, where the voxel cube reaches from −1 to 1. */
export interface Gaussians extends Handle {
  /**
   * Views, valid until the library is next called; of shared memory if it has threads.
   * world = origin + (position + 1) · unit.
   */
  arrays(): {
    count: number;
    /** x, y, z of centres. */
    position: Float32Array;
    /** Standard deviations along the Gaussian's axes. */
    scale: Float32Array;
    /** Unit quaternions w, x, y, z. */
    rotation: Float32Array;
    /** In [0, 1]. */
    opacity: Float32Array;
    /** Red, green, blue in [0, 1]. */
    colour: Float32Array;
    origin: [number, number, number];
    unit: number;
  };
  /** Red, green, blue, alpha of each pixel, premultiplied, row by row from the top left. */
  render(view: View): Uint8ClampedArray;
}

/** An eye that looks at the centre of the cube. */
export interface Camera {
  /** Degrees around the vertical axis. */
  azimuth?: number;
  /** Degrees above the horizon. */
  elevation?: number;
  distance?: number;
  /** Horizontal field of view in degrees. */
  fov?: number;
}

export interface View extends Camera {
  width: number;
  height: number;
  /** `null` is transparent; white if it is left out. */
  background?: Colour | null;
}

/**
 * A canvas that shows a stream, a sequence or a file of Gaussians, with the library in a worker. Events: `level`
 * (`detail`: level, `null` for a file of Gaussians, count, milliseconds), `picture` (milliseconds, scale), `failure` (kind,
 * message); of a sequence `sequence` (seconds, frames, base, top), `frame` (number, time, level, heads, count, dropped),
 * `skipped` (number, kind, message).
 */
export class Viewer extends EventTarget {
  constructor(
    canvas: HTMLCanvasElement,
    options?: {
      wasm?: string | URL;
      /** The library with threads, for pages that are isolated from other origins. */
      threads?: string | URL | null;
      worker?: string | URL;
      heads?: string | URL | null;
      background?: Colour | null;
    },
  );
  get camera(): Required<Camera>;
  set camera(camera: Camera);
  /** Ends with the last level, when it is there; with `null` for a file of Gaussians. */
  open(
    source: string | URL | Response | Blob | BufferSource | ReadableStream<Uint8Array>,
    options?: { heads?: Heads | null; level?: number },
  ): Promise<number | null>;
  /** How long the picture took, or `null` if there was nothing to draw, or another one was asked for. */
  draw(): Promise<number | null>;
  readonly playing: boolean;
  play(): void;
  /** Stays at the frame that is shown, at its finest level. */
  pause(): void;
  seek(seconds: number): void;
  /** Pauses so many frames further on, or back. */
  step(by: number): void;
  /** From ⅛ to 8. */
  set speed(speed: number);
  reset(): void;
  close(): void;
}
