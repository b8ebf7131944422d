export { B2p, B2pError, Decoding, Gaussians, HeadsModel } from "./b2p.js";
export { Viewer } from "./viewer.js";
