# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser, Chromium without a window; WebGL is drawn by the processor."""

from __future__ import annotations

import gzip
import hashlib
import io
import re
import shutil
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from raytran.structs import CLASS_COLORS, CLASSES

from .conftest import write_result

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE_MS = 120_000
LAYERS = ("meshes", "boxes", "labels", "cameras", "truth", "voxels")
THREE_SHA256 = "48504ba17b3cdf2f028f9bb3e2766a69c3debefd2815acf026ced7fa2152dfb8"


def page_file(project_root, name):
    return project_root / "src" / "raytran" / "viewer" / "page" / name


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install playwright)")
    if CHROMIUM is None:
        pytest.skip("needs Chromium (apt install chromium)")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


class Seen:
    """A page, and what its console and its requests were."""

    def __init__(self, browser, address):
        self.page = browser.new_page(viewport={"width": 900, "height": 560})
        self.page.set_default_timeout(PATIENCE_MS)
        self.complaints, self.requests = [], []
        self.page.on("console", lambda line: self.complaints.append(f"{line.type}: {line.text}"))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)
        self.page.wait_for_selector("html[data-ready]")

    def run(self, expression, *given):
        return self.page.evaluate(expression, *given)

    def until(self, condition):
        """Wait for an expression to be true; the page's own rules forbid the browser to do so by itself."""
        end = time.monotonic() + PATIENCE_MS / 1000
        while not self.run(condition):
            assert time.monotonic() < end, condition
            time.sleep(0.05)

    def show(self, *layers):
        """Switch on these layers and no others."""
        for name in LAYERS:
            self.page.locator(f"#show-{name}").set_checked(name in layers)

    def draw(self):
        """Return the picture of the scene as ``(H, W, 3)`` numbers, after everything was drawn."""
        self.run("raytran.world.drawn().then(() => raytran.world.drawn())")
        png = self.page.locator("#world").screenshot(timeout=PATIENCE_MS)
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)

    def text(self, selector):
        return self.page.inner_text(selector)


def colored(image, category):
    """Return how many pixels of a picture have about the hue of a class."""
    color = np.array(CLASS_COLORS[CLASSES.index(category)]) / 255
    flat = image.reshape(-1, 3) / 255
    flat = flat - flat.mean(axis=1, keepdims=True)
    wanted = color - color.mean()
    strength = np.linalg.norm(flat, axis=1)
    cosine = flat @ wanted / np.maximum(strength * np.linalg.norm(wanted), 1e-9)
    return int(((cosine > 0.97) & (strength > 0.15)).sum())


@pytest.fixture(scope="module")
def one_page(browser, result, serve):
    with serve(result) as server:
        seen = Seen(browser, server.url)
        yield seen
        seen.page.close()
    hosts = {urlsplit(url).hostname for url in seen.requests if not url.startswith(("data:", "blob:"))}
    assert hosts == {"127.0.0.1"}


@pytest.fixture
def seen(one_page):
    """The page of a scene as it opens; afterwards nothing may have been complained of."""
    one_page.show("meshes", "boxes", "labels", "cameras", "truth")
    one_page.run("raytran.open(0)")
    yield one_page
    assert one_page.complaints == []


def test_boxes_and_meshes_are_drawn_where_they_are(seen):
    seen.show("meshes", "boxes")
    with_both = seen.draw()
    seen.show("boxes")
    only_boxes = seen.draw()
    seen.show()
    empty = seen.draw()
    for index, category in enumerate(CLASSES[:6]):
        x, y = seen.run(f"raytran.world.project(raytran.state.data.objects[{index}].center)")
        here = with_both[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3]
        assert np.abs(here - empty[round(y), round(x)]).sum(axis=2).min() > 60, category
        both, box, none = (colored(image, category) for image in (with_both, only_boxes, empty))
        assert both > 1.5 * box > 30, category
        assert none == 0, category


def test_a_slider_hides_what_is_weak(seen):
    assert seen.text("#count") == "6 of 6"
    assert "1 of 6 true objects found" in seen.text("#found")
    assert "missed: bookshelf, cabinet, chair, display, sofa." in seen.text("#found")
    seen.show("meshes", "boxes")
    before = seen.draw()
    seen.run(
        "(() => { const score = document.getElementById('score'); score.value = 0.9;"
        "score.dispatchEvent(new Event('input')); })()"
    )
    assert seen.text("#count") == "1 of 6"
    after = seen.draw()
    assert colored(after, "bathtub") == pytest.approx(colored(before, "bathtub"), rel=0.3)
    assert colored(before, "sofa") > 100
    assert colored(after, "sofa") == 0
    assert seen.page.locator("#objects tr.weak").count() == 5


def test_errors_stand_beside_objects(seen):
    cells = seen.page.locator("#objects tr").nth(0).locator("td").all_inner_texts()
    assert cells == ["00 bathtub", "0.95", "0.0", "0", "0 %", "1.00"]
    cells = seen.page.locator("#objects tr").nth(1).locator("td").all_inner_texts()
    assert cells[2:5] == ["30.0", "0", "0 %"]
    seen.page.click("#objects tr:nth-child(2)")
    assert seen.page.locator("#objects tr.selected").count() == 1
    assert "0.80 × 0.60 × 0.50 m" in seen.text("#details")
    assert "not within the limits" in seen.text("#details")


def test_an_object_is_chosen_in_the_scene(seen):
    x, y = seen.run("raytran.world.project(raytran.state.data.objects[3].center)")
    seen.page.locator("#canvas").click(position={"x": x, "y": y})
    assert seen.run("raytran.state.object") == 3
    seen.page.locator("#canvas").click(position={"x": 3, "y": 3})
    assert seen.run("raytran.state.object") is None


def test_frames_are_clicked_through(seen):
    assert seen.text("#frame-name") == "000000, 1 of 5"
    seen.page.click("#next")
    assert seen.text("#frame-name") == "000010, 2 of 5"
    seen.page.keyboard.press("ArrowLeft")
    seen.page.keyboard.press("ArrowLeft")
    assert seen.text("#frame-name") == "000040, 5 of 5"
    seen.page.click("#strip button:nth-child(3)")
    assert seen.text("#frame-name") == "000020, 3 of 5"
    seen.page.click("#fly")
    place = seen.run("raytran.world.camera.position.toArray()")
    pose = seen.run("raytran.state.data.frames[2].world_from_camera.map((row) => row[3]).slice(0, 3)")
    assert place == pytest.approx(pose, abs=1e-5)
    # What stands in the middle of the picture stands in the middle of the scene.
    middle = seen.run("raytran.world.project([0, 0, 0.4])")
    area = seen.page.locator("#canvas").bounding_box()
    assert middle == pytest.approx([area["width"] / 2, area["height"] / 2], abs=1)


def test_a_voxel_shows_what_it_read(seen):
    seen.page.click("#frame", position={"x": 150, "y": 180})
    seen.until("raytran.state.reads !== null")
    reads = seen.run("raytran.state.reads")
    assert sum(read["weight"] for read in reads) == pytest.approx(1.0)
    text = seen.text("#voxel")
    found = re.search(
        r"Voxel \((\d+), (\d+), (\d+)\), occupied 1\.00, seen by \d+ of 5 views\. It read (\d+) pixels", text
    )
    assert found, text
    assert int(found[4]) == len(reads)
    # Through the cameras: the voxel lies in the cells that it is said to have read.
    frames, volume = seen.run("[raytran.state.data.frames, raytran.state.data.volumes[0]]")
    center, extent, resolution = (np.array(volume[name]) for name in ("center", "extent", "resolution"))
    voxel = np.array([int(part) for part in found.groups()[:3]])
    point = center + (voxel + 0.5 - resolution / 2) * extent / resolution
    for index in {read["frame"] for read in reads}:
        in_camera = np.linalg.inv(np.array(frames[index]["world_from_camera"])) @ [*point, 1]
        u, v, depth = np.array(frames[index]["intrinsics"]) @ in_camera[:3]
        cells = [(read["column"] + 0.5, read["row"] + 0.5) for read in reads if read["frame"] == index]
        away = np.abs(np.array(cells) * 16 - [u / depth, v / depth]).max(axis=1)
        assert away.min() < 12, index  # a cell is 16 pixels wide
    widths = [bar.evaluate("bar => bar.style.width") for bar in seen.page.locator("#strip i").all()]
    assert sum(width != "0px" for width in widths) == len({read["frame"] for read in reads})


def test_voxels_are_drawn_and_thinned(seen):
    seen.show()
    empty = seen.draw()
    seen.show("voxels")
    full = seen.draw()
    assert (np.abs(full - empty).sum(axis=2) > 30).sum() > 2000
    seen.page.select_option("#voxel-color", "seen")
    assert (np.abs(seen.draw() - full).sum(axis=2) > 30).sum() > 2000
    seen.run("raytran.state.data.volumes[0].occupancy.fill(100)")
    seen.page.select_option("#voxel-color", "occupancy")
    assert (np.abs(seen.draw() - empty).sum(axis=2) > 30).sum() == 0


def test_many_scenes_and_what_they_lack(browser, tmp_path, serve):
    bare = write_result(tmp_path / "all" / "bare", num_objects=3, with_view=False)
    (bare / "scene.glb").write_bytes(b"glTF, but not really")
    damaged = write_result(tmp_path / "all" / "damaged", num_objects=1, with_view=False)
    (damaged / "scene.json").write_text('{"format": "raytran.scene/9"}')
    write_result(tmp_path / "all" / "full", num_objects=2, num_frames=4, in_parts=True)
    empty = write_result(tmp_path / "all" / "too long", num_objects=1, num_frames=2)
    (empty / "view" / "volume0_occupancy.gz").write_bytes(gzip.compress(bytes(10_000_000)))
    with serve(tmp_path / "all") as server:
        seen = Seen(browser, server.url)
        assert seen.page.locator("#scenes option").all_inner_texts() == [
            "bare",
            "damaged",
            "full",
            "too long",
        ]
        assert "no meshes" in seen.text("#status")
        assert seen.text("#count") == "3 of 3"
        assert not seen.page.is_visible("#frame")
        assert not seen.page.is_visible("#show-voxels")
        seen.page.select_option("#scenes", "1")
        seen.page.wait_for_selector("#status:has-text('raytran.scene/9')")
        seen.page.select_option("#scenes", "2")
        seen.until("document.title === 'full' && document.documentElement.dataset.ready !== undefined")
        assert seen.text("#count") == "2 of 2"
        assert seen.page.is_visible("#frame")
        assert seen.text("#status") == ""
        # The right half of a large room, of which only the last two frames tell.
        seen.run("raytran.pickVoxel([0.7, 0.2, 0.2])")
        seen.until("raytran.state.reads !== null")
        assert {read["frame"] for read in seen.run("raytran.state.reads")} <= {2, 3}
        assert re.search(
            r"It read \d+ pixels of (1 frame|2 frames), most of frame 0000[23]0", seen.text("#voxel")
        )
        seen.page.select_option("#scenes", "3")
        seen.page.wait_for_selector("#status:has-text('not as long as view.json says')")
        seen.page.close()


def test_colors_are_those_of_all_pictures(project_root):
    text = page_file(project_root, "data.js").read_text()
    found = dict(re.findall(r'^  (\w+): "(#[0-9a-f]{6})",$', text, re.MULTILINE))
    assert found == {
        name: "#{:02x}{:02x}{:02x}".format(*color) for name, color in zip(CLASSES, CLASS_COLORS, strict=True)
    }


def test_the_library_is_the_one_its_readme_describes(project_root):
    content = gzip.decompress(page_file(project_root, "vendor/three.js.gz").read_bytes())
    assert hashlib.sha256(content).hexdigest() == THREE_SHA256
    assert page_file(project_root, "vendor/three.LICENSE").read_text().startswith("The MIT License")
