"""Tests of `b2p view` and `b2p play` from outside, with keys and a mouse. `tests/view.sh` has what they need."""

import importlib.util
import json
import os
import pathlib
import pty
import re
import select
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
import unittest
import zlib

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROGRAM = os.environ.get("B2P_PROGRAM", str(ROOT / "target/debug/b2p"))
BLOCKS = ROOT / "tests/data/conformance/scenes/ball.b2p"
SAMPLE, SCENE = ROOT / "models/sample.b2p", ROOT / "models/scene.b2p"
# Seconds after which something that was to happen is held not to.
PATIENCE = 120


def wait_for(what, condition):
    """What `condition` gives once that is true."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError(f"never: {what}")


def png(path):
    """Width, height, and pixels (r, g, b) of a PNG file of eight bits with alpha."""
    data = pathlib.Path(path).read_bytes()
    at, packed = 8, b""
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack_from(">IIBB", body)
            assert (depth, colour) == (8, 6)
        packed += body if kind == b"IDAT" else b""
        at += length + 12
    rows, raw, stride = [], zlib.decompress(packed), 4 * width
    before = bytearray(stride)
    for y in range(height):
        kind, row = raw[y * (stride + 1)], bytearray(raw[y * (stride + 1) + 1 : (y + 1) * (stride + 1)])
        for x in range(stride):
            a, b, c = (row[x - 4] if x > 3 else 0), before[x], (before[x - 4] if x > 3 else 0)
            p = a + b - c
            nearest = min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c))[2]
            row[x] = row[x] + (0, a, b, (a + b) // 2, nearest)[kind] & 255
        rows.append(row)
        before = row
    return width, height, [tuple(row[x : x + 3]) for row in rows for x in range(0, stride, 4)]


def difference(one, other):
    """The largest difference of two lists of pixels."""
    assert len(one) == len(other), (len(one), len(other))
    return max(max(abs(x - y) for x, y in zip(a, b)) for a, b in zip(one, other))


def sequence(folder):
    """A sequence of 24 frames, 8 a second: a ball of points that moves by a voxel each frame."""
    (folder / "frames").mkdir()
    axis = range(-6, 7)
    ball = [(x, y, z) for x in axis for y in axis for z in axis if 25 < x * x + y * y + z * z <= 36]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(ball)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {colour}\n" for colour in ("red", "green", "blue")) + "end_header\n"
    for frame in range(24):
        rows = [f"{x + frame} {y} {z} {100 + 16 * x} {100 + 16 * y} 90\n" for x, y, z in ball]
        (folder / "frames" / f"{frame:02}.ply").write_text(header + "".join(rows))
    encoded = folder / "ball.b2p"
    options = ["--fps", "8", "--gop", "6", "--bits", "6", "--levels", "3..5"]
    subprocess.run([PROGRAM, "-q", "encode", folder / "frames", "-o", encoded, *options], check=True)
    return encoded


class Screen:
    """An X server without a screen, whose pixels are in a file."""

    def __init__(self):
        self.folder = tempfile.mkdtemp(prefix="b2p-view-")
        read, write = os.pipe()
        options = ["-screen", "0", "1280x1024x24", "-fbdir", self.folder, "-noreset", "-nolisten", "tcp"]
        options += ["-displayfd", str(write)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen(["Xvfb", *options], pass_fds=[write], **quiet)
        os.close(write)
        with open(read) as number:
            self.name = ":" + number.readline().strip()

    def pixels(self, left, top, width, height):
        data = pathlib.Path(self.folder, "Xvfb_screen0").read_bytes()
        fields = struct.unpack_from(">25I", data)
        start, stride, little = fields[0] + 12 * fields[19], fields[12], fields[7] == 0
        order = (2, 1, 0) if little else (1, 2, 3)
        pixels = []
        for y in range(top, top + height):
            row = data[start + y * stride + 4 * left : start + y * stride + 4 * (left + width)]
            pixels += [(row[x + order[0]], row[x + order[1]], row[x + order[2]]) for x in range(0, len(row), 4)]
        return pixels

    def close(self):
        self.process.terminate()
        self.process.wait()
        shutil.rmtree(self.folder)


class Viewer:
    """The program in a window."""

    def __init__(self, screen, folder, *arguments, stdin=subprocess.DEVNULL, size="320x240", command="view"):
        self.screen, self.folder = screen, folder
        environment = {name: value for name, value in os.environ.items() if name != "WAYLAND_DISPLAY"}
        self.environment = environment | {"DISPLAY": screen.name, "WINIT_X11_SCALE_FACTOR": "1"}
        self.errors = open(folder / "errors.txt", "w+")
        command = [PROGRAM, command, "--json", "--size", size, "-o", str(folder), *map(str, arguments)]
        self.process = subprocess.Popen(
            command, env=self.environment, stdin=stdin, stdout=subprocess.PIPE, stderr=self.errors
        )
        find = ["search", "--onlyvisible", "--pid", str(self.process.pid)]
        self.window = wait_for("a window", lambda: self.process.poll() is not None or self.ask(*find))
        assert self.process.poll() is None, self.said()
        self.window = self.window.split()[0]
        self.ask("windowfocus", "--sync", self.window)

    def ask(self, *arguments):
        done = subprocess.run(["xdotool", *arguments], env=self.environment, capture_output=True, text=True)
        return done.stdout

    def title(self):
        return self.ask("getwindowname", self.window).strip()

    def press(self, *keys):
        self.ask("key", "--delay", "30", *keys)

    def geometry(self):
        found = dict(line.split("=") for line in self.ask("getwindowgeometry", "--shell", self.window).split())
        return [int(found[name]) for name in ("X", "Y", "WIDTH", "HEIGHT")]

    def pixels(self, whole=True):
        """What is shown, without the pointer, once it does not change any more."""
        self.ask("mousemove", "1279", "1023")
        last, since = None, 0.0
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            now = self.screen.pixels(*self.geometry())
            if now != last or (whole and "decoding" in self.title()):
                last, since = now, time.monotonic()
            elif time.monotonic() - since > 0.7 and len(set(now)) > 1:
                return now
            time.sleep(0.05)
        raise AssertionError("the window never comes to rest")

    def said(self):
        return pathlib.Path(self.errors.name).read_text()

    def screenshot(self, whole=True):
        """The file of a screenshot, and the options of `render` that draw it."""
        before = set(self.folder.glob("*.png"))
        line = wait_for("a picture to save", lambda: self.pixels(whole)) and len(self.said().splitlines())
        self.press("s")
        wait_for("a line about the screenshot", lambda: len(self.said().splitlines()) > line)
        (path,) = set(self.folder.glob("*.png")) - before
        command = re.search("`b2p (.*)`", self.said().splitlines()[-1])[1]
        return path, shlex.split(command)

    def rendered(self, command, *more):
        """The picture that `render` draws."""
        to = self.folder / "rendered" / "picture.png"
        to.parent.mkdir(exist_ok=True)
        subprocess.run([PROGRAM, "-q", "--force", *command, *more, "-o", str(to)], check=True)
        return png(to)

    def close(self):
        if self.process.poll() is None:
            self.press("q")
        result = self.process.communicate(timeout=PATIENCE)[0]
        self.errors.close()
        return self.process.returncode, result


class WindowTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.screen = Screen()
        cls.addClassCleanup(cls.screen.close)

    def viewer(self, *arguments, **options):
        folder = pathlib.Path(tempfile.mkdtemp(prefix="b2p-view-"))
        self.addCleanup(shutil.rmtree, folder)
        viewer = Viewer(self.screen, folder, *arguments, **options)
        self.addCleanup(viewer.close)
        return viewer

    def test_a_screenshot_is_what_render_draws_and_what_the_window_shows(self):
        viewer = self.viewer(SCENE)
        shown = viewer.pixels()
        path, command = viewer.screenshot()
        width, height, saved = png(path)
        self.assertEqual([width, height], [320, 240])
        self.assertEqual(saved, shown)
        self.assertLessEqual(difference(saved, viewer.rendered(command)[2]), 1)
        status, result = viewer.close()
        self.assertEqual(status, 0)
        self.assertGreater(json.loads(result)["pictures"], 0)

    def test_keys_change_level_and_heads(self):
        viewer = self.viewer(SCENE)
        finest = viewer.pixels()
        levels = json.loads(subprocess.run([PROGRAM, "--json", "info", SCENE], capture_output=True).stdout)
        level = max(level["level"] for level in levels["levels"]) - 1
        viewer.press("bracketleft")
        path, command = viewer.screenshot()
        coarser = png(path)[2]
        self.assertNotEqual(coarser, finest)
        self.assertLessEqual(difference(coarser, viewer.rendered(command, "--level", str(level))[2]), 1)
        viewer.press("bracketright", "h", "h")
        path, command = viewer.screenshot()
        self.assertLessEqual(difference(png(path)[2], viewer.rendered(command, "--heads", "surfels")[2]), 1)
        viewer.press("h")
        wait_for("the first picture again", lambda: viewer.pixels() == finest)

    def test_a_drag_turns_and_a_reset_undoes_it(self):
        viewer = self.viewer(SCENE)
        before = viewer.pixels()
        for button, keys in [("1", []), ("3", []), ("1", ["shift"])]:
            viewer.ask("mousemove", "--window", viewer.window, "100", "100")
            for key in keys:
                viewer.ask("keydown", key)
            viewer.ask("mousedown", button)
            for step in range(1, 11):
                viewer.ask("mousemove", "--window", viewer.window, str(100 + 6 * step), str(100 + 2 * step))
            viewer.ask("mouseup", button)
            for key in keys:
                viewer.ask("keyup", key)
            moved = viewer.pixels()
            self.assertNotEqual(moved, before)
            path, command = viewer.screenshot()
            self.assertLessEqual(difference(png(path)[2], viewer.rendered(command)[2]), 1)
            viewer.press("r")
            wait_for("the first picture again", lambda: viewer.pixels() == before)
        viewer.ask("mousemove", "--window", viewer.window, "100", "100", "click", "4")
        self.assertNotEqual(viewer.pixels(), before)
        viewer.press("Home")
        wait_for("the first picture again", lambda: viewer.pixels() == before)
        viewer.press("Left", "Up")
        self.assertNotEqual(viewer.pixels(), before)
        viewer.press("Down", "Right")
        wait_for("the first picture again", lambda: difference(viewer.pixels(), before) <= 1)

    def test_a_window_of_another_size_has_a_picture_of_that_size(self):
        viewer = self.viewer(SCENE)
        viewer.pixels()
        viewer.ask("windowsize", "--sync", viewer.window, "200", "300")
        wait_for("another size", lambda: viewer.geometry()[2:] == [200, 300])
        shown = viewer.pixels()
        path, command = viewer.screenshot()
        self.assertEqual(png(path), (200, 300, shown))
        self.assertLessEqual(difference(shown, viewer.rendered(command)[2]), 1)

    def test_words_and_a_box_are_drawn_over_the_picture_and_go_again(self):
        viewer = self.viewer(SCENE, size="480x480")
        before = viewer.pixels()
        for key in ["question", "t", "c"]:
            viewer.press(key)
            wait_for(f"something after {key}", lambda: viewer.pixels() != before)
            viewer.press(key)
            wait_for(f"nothing after {key}", lambda: viewer.pixels() == before)
        covered = sum(pixel != (255, 255, 255) for pixel in before)
        viewer.press("c", "y", *["less"] * 20)
        path, _ = viewer.screenshot()
        left = sum(pixel != (255, 255, 255) for pixel in png(path)[2])
        self.assertTrue(0 < left < 0.95 * covered, (left, covered))
        viewer.press("c", "b", "b")
        self.assertEqual(viewer.pixels()[0], (0, 0, 0))

    def test_files_of_a_folder_come_one_after_the_other_and_a_dropped_one_after_them(self):
        viewer = self.viewer(SAMPLE.parent)
        count = int(re.search(r"\(1 of (\d+)\)", viewer.title())[1])
        names = set()
        for _ in range(count):
            names.add(viewer.title().split(" ")[0])
            viewer.pixels()
            viewer.press("n")
        self.assertEqual(len(names), count)
        self.assertLessEqual({"sample.b2p", "scene.b2p"}, names)
        wait_for("the first file again", lambda: "(1 of" in viewer.title())
        if importlib.util.find_spec("Xlib") is None:
            self.skipTest("python-xlib cannot be had: no file is dropped")
        dropped = viewer.folder / "dropped file.ply"
        subprocess.run([PROGRAM, "-q", "decode", SAMPLE, dropped], check=True)
        xdnd = [sys.executable, str(ROOT / "tests/xdnd.py"), viewer.window, str(dropped)]
        subprocess.run(xdnd, env=viewer.environment, check=True)
        wait_for("the dropped file", lambda: viewer.title().startswith("dropped file.ply"))
        path, command = viewer.screenshot()
        self.assertLessEqual(difference(png(path)[2], viewer.rendered(command)[2]), 1)

    def test_a_stream_is_drawn_while_it_arrives_and_the_camera_stays(self):
        stream = SCENE.read_bytes()
        viewer = self.viewer("-", stdin=subprocess.PIPE)
        half = len(stream) // 2
        viewer.process.stdin.write(stream[:half])
        viewer.process.stdin.flush()
        early, coarse = viewer.screenshot(whole=False)
        viewer.process.stdin.write(stream[half:])
        viewer.process.stdin.close()
        viewer.process.stdin = None
        before = png(early)[2]
        late, fine = wait_for("a finer picture", lambda: viewer.pixels() != before and viewer.screenshot())
        self.assertEqual(coarse, fine)
        self.assertNotEqual(png(late)[2], before)

    def test_a_scene_of_blocks_is_shown_and_keys_change_its_level(self):
        viewer = self.viewer(BLOCKS, "--heads", "surfels")
        shown = viewer.pixels()
        path, command = viewer.screenshot()
        self.assertEqual(png(path)[2], shown)
        self.assertLessEqual(difference(shown, viewer.rendered(command, "--heads", "surfels")[2]), 1)
        viewer.press("bracketleft")
        coarse = wait_for("another level", lambda: (now := viewer.pixels()) != shown and now)
        viewer.press("bracketright")
        wait_for("the finest level again", lambda: viewer.pixels() == shown)
        self.assertNotEqual(coarse, shown)

    def test_a_sequence_plays_and_is_paused_stepped_through_and_sought(self):
        folder = pathlib.Path(tempfile.mkdtemp(prefix="b2p-view-"))
        self.addCleanup(shutil.rmtree, folder)
        detail = ["--level", "5", "--heads", "surfels"]
        viewer = self.viewer(sequence(folder), *detail, command="play")
        wait_for("the sequence to play", lambda: viewer.title() == "ball.b2p – b2p")
        for _ in range(2):
            before = self.screen.pixels(*viewer.geometry())
            wait_for("another frame", lambda: self.screen.pixels(*viewer.geometry()) != before)

        def paused():
            found = re.search(r"paused at frame (\d+) of 24", viewer.title())
            return found and int(found[1])

        viewer.press("space")
        wait_for("a pause", lambda: paused() is not None)
        above = slice(0, 320 * 216)  # the time line
        frame, shown = paused(), viewer.pixels()
        time.sleep(1)
        self.assertEqual((paused(), viewer.pixels()), (frame, shown))
        viewer.press("period")
        wait_for("the next frame", lambda: paused() == (frame + 1) % 24)
        self.assertNotEqual(viewer.pixels()[above], shown[above])
        viewer.press("comma")
        wait_for("the frame before", lambda: paused() == frame)
        self.assertEqual(viewer.pixels()[above], shown[above])
        for x, sought in [(244, 18), (4, 0), (124, 9)]:
            viewer.ask("mousemove", "--window", viewer.window, str(x), "236", "click", "1")
            wait_for(f"frame {sought}", lambda: paused() == sought)
            path, command = viewer.screenshot()
            self.assertEqual(command[-2:], ["--frame", str(sought)])
            self.assertLessEqual(difference(png(path)[2], viewer.rendered(command, *detail)[2]), 1)
        viewer.press("space")
        wait_for("the sequence to play", lambda: paused() is None)
        status, result = viewer.close()
        played = json.loads(result)["sequence"]
        self.assertEqual((status, played["skips"]), (0, 0))
        self.assertGreater(played["frames"], 5)

    def test_at_rest_it_sleeps(self):
        viewer = self.viewer(SCENE)
        viewer.pixels()

        def ticks():
            fields = pathlib.Path(f"/proc/{viewer.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
            return int(fields[11]) + int(fields[12])

        before = ticks()
        time.sleep(2)
        self.assertLessEqual(ticks() - before, 2)

    def test_the_window_manager_closes_it(self):
        viewer = self.viewer(SCENE)
        viewer.ask("windowquit", viewer.window)
        self.assertEqual(viewer.close()[0], 0)

    def test_a_damaged_file_alone_ends_it_with_an_error(self):
        with tempfile.TemporaryDirectory() as folder:
            damaged = pathlib.Path(folder, "damaged.b2p")
            stream = bytearray(SCENE.read_bytes())
            stream[len(stream) // 100] ^= 0x55
            damaged.write_bytes(stream)
            environment = os.environ | {"DISPLAY": self.screen.name}
            done = subprocess.run([PROGRAM, "view", damaged], env=environment, capture_output=True, timeout=PATIENCE)
            self.assertEqual(done.returncode, 1)
            self.assertIn(b"damaged.b2p", done.stderr)


class TerminalTest(unittest.TestCase):
    def run_view(self, *arguments):
        environment = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
        return subprocess.run([PROGRAM, "view", *map(str, arguments)], env=environment, capture_output=True)

    def test_without_a_display_it_says_what_does(self):
        done = self.run_view(SCENE)
        self.assertEqual(done.returncode, 1)
        self.assertIn(b"--terminal", done.stderr)

    def test_half_blocks_have_the_colours_of_the_picture(self):
        done = self.run_view("--terminal", SCENE, "--size", "40x20", "--orbit", "0,0")
        self.assertEqual((done.returncode, done.stderr), (0, b""))
        rows = done.stdout.decode().split("\r\n")[:-1]
        self.assertEqual([row.count("▀") for row in rows], [40] * 20)
        shown, colours = [], None
        for row in rows:
            upper, lower = [], []
            for numbers, blocks in re.findall("\x1b\\[38;2;([0-9;]*)m(▀+)", row):
                r, g, b, _, _, s, h, c = map(int, numbers.split(";"))
                upper += [(r, g, b)] * len(blocks)
                lower += [(s, h, c)] * len(blocks)
            shown += upper + lower
        with tempfile.TemporaryDirectory() as folder:
            picture = pathlib.Path(folder, "picture.png")
            subprocess.run([PROGRAM, "-q", "render", SCENE, picture, "--size", "40x40", "--level", "8"], check=True)
            drawn = png(picture)[2]
        mean = sum(sum(abs(x - y) for x, y in zip(a, b)) for a, b in zip(shown, drawn)) / len(drawn) / 3
        self.assertLess(mean, 8)

    def test_sixels_are_written_where_they_are_asked_for(self):
        done = self.run_view(SCENE, "--terminal", "sixel", "--size", "20x10")
        self.assertEqual(done.returncode, 0)
        self.assertTrue(done.stdout.startswith(b'\x1bP0;1;0q"1;1;160;160'))
        self.assertTrue(done.stdout.endswith(b"\x1b\\\n"))

    def test_keys_turn_the_picture_and_the_terminal_is_left_as_it_was(self):
        main, other = pty.openpty()
        termios.tcsetwinsize(other, (24, 60))
        before = termios.tcgetattr(other)
        process = subprocess.Popen([PROGRAM, "view", "--terminal", SCENE], stdin=other, stdout=other, stderr=other)
        heard = b""

        def hear(what):
            nonlocal heard
            while select.select([main], [], [], 0.05)[0]:
                heard += os.read(main, 65536)
            return what()

        wait_for("a picture", lambda: hear(lambda: b"? for keys" in heard and b"decoding" not in heard[-200:]))
        first = heard
        heard = b""
        os.write(main, b"\x1b[C")
        wait_for("another picture", lambda: hear(lambda: "▀".encode() in heard))
        self.assertNotEqual(first[-len(heard) :], heard)
        os.write(main, b"?")
        wait_for("the keys", lambda: hear(lambda: b"reset the camera" in heard or b"turn" in heard))
        os.write(main, b"q")
        wait_for("the end", lambda: hear(lambda: process.poll() is not None))
        self.assertEqual(process.returncode, 0)
        self.assertTrue(heard.rstrip().endswith(b"\x1b[0m"), heard[-50:])
        self.assertEqual(termios.tcgetattr(other), before)
        os.close(main)
        os.close(other)


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    unittest.main()
