"""Drops a file on a window of an X server, by the protocol XDND: `xdnd.py WINDOW FILE`. It needs python-xlib."""

import pathlib
import sys
import time

from Xlib import X, display
from Xlib.protocol import event


def drop(number, path):
    connection = display.Display()
    target = connection.create_resource_object("window", number)
    source = connection.screen().root.create_window(0, 0, 1, 1, 0, X.CopyFromParent)
    atom = connection.intern_atom
    uris, selection = atom("text/uri-list"), atom("XdndSelection")
    source.set_selection_owner(selection, X.CurrentTime)

    def send(name, data):
        message = event.ClientMessage(window=target, client_type=atom(name), data=(32, [source.id, *data]))
        target.send_event(message)
        connection.flush()

    place = target.query_tree().parent.translate_coords(target, 20, 20)
    send("XdndEnter", [5 << 24, uris, 0, 0])
    send("XdndPosition", [0, place.x << 16 | place.y, X.CurrentTime, atom("XdndActionCopy")])
    dropped, end = False, time.monotonic() + 10
    while time.monotonic() < end:
        if not connection.pending_events():
            time.sleep(0.01)
            continue
        heard = connection.next_event()
        if heard.type == X.SelectionRequest:
            text = (pathlib.Path(path).resolve().as_uri() + "\r\n").encode()
            heard.requestor.change_property(heard.property, uris, 8, text)
            answer = event.SelectionNotify(
                time=heard.time,
                requestor=heard.requestor,
                selection=heard.selection,
                target=heard.target,
                property=heard.property,
            )
            heard.requestor.send_event(answer)
            connection.flush()
        elif heard.type == X.ClientMessage:
            kind = connection.get_atom_name(heard.client_type)
            if kind == "XdndStatus" and not dropped:
                dropped = True
                send("XdndDrop", [0, X.CurrentTime, 0, 0])
            elif kind == "XdndFinished":
                return
    raise SystemExit("the window did not take the file")


if __name__ == "__main__":
    drop(int(sys.argv[1]), sys.argv[2])
