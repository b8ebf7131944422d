/** What a stream or an argument is refused for. `kind` is one of the statuses of the C interface, in lower case. */
export class B2pError extends Error {
  constructor(kind, message) {
    super(message);
    this.name = "B2pError";
    this.kind = kind;
  }
}
