"""Takes the screenshots of README.md and docs: pictures.py FOLDER [rehearsal | pages | class]

`rehearsal` is the output of `rehearse`. `pages` show the demo at work: two simulation servers and one that is down,
with clients that came and went while the charts filled. `class` shows twelve students, and a list of 200.
"""

import base64
import html
import json
import pathlib
import subprocess
import sys
import urllib.request

from browser import Browser
from demo import Demo
from fleet import BIN, SOON, until
from playwright.sync_api import expect
from students import NAMES, start_all

# The time span of the charts, in seconds.
HISTORY = 600
WIDTH = 1200
# Pictures of a part of a page are cropped to this height.
HIGHEST = 720
PASSWORD = "open sesame"
PLAYGROUND = "https://github.com/webots-fleet/demo/blob/main/worlds/playground.wbt"
REHEARSAL = ["--world", PLAYGROUND, "--clients", "30", "--over", "5s", "--stay", "20s", "--patience", "12s"]
TERMINAL = """
    <!doctype html><meta charset="utf-8">
    <style>
    body { margin: 0; background: #16202a }
    pre { margin: 24px; color: #e8eef2; font: 15px/1.4 monospace }
    </style>
    <pre>%s</pre>"""


def start(browser, demo, world, width=360, height=300, name=""):
    """A viewer in which a user of this name runs a world; small, because drawing is expensive."""
    page = browser.page(width=width, height=height)
    page.tab.goto(f"http://{demo.session}/viewer?name={name}")
    expect(page.tab.locator("#availability.on")).to_be_visible()
    page.tab.get_by_role("button", name=world).click()
    page.tab.get_by_role("button", name="Connect", exact=True).click()
    page.tab.get_by_role("button", name="Play", exact=True).click()
    return page


def samples(demo):
    """The number of samples in the charts, one per second."""
    with urllib.request.urlopen(f"http://{demo.simulation}/history", timeout=SOON) as answer:
        return len(json.loads(answer.read()))


def wait(demo, count):
    """Waits until the charts have this many samples."""
    for more in range(samples(demo), count + 1, 5):
        until(f"{more} seconds have passed", lambda: samples(demo) >= more)


def shoot(page, folder, name, hosts, part=None, margin=16, whole=True):
    """Takes a picture of a page, of one of its parts, or of the visible area."""
    if whole:
        page.tab.evaluate("scrollTo(0, 0)")
    x, y, width, height = page.tab.evaluate("[0, scrollY, innerWidth, innerHeight]")
    if part:
        box = part.bounding_box()
        x, y, width, height = (
            box["x"] - margin,
            box["y"] - margin,
            box["width"] + 2 * margin,
            box["height"] + 2 * margin,
        )
        height = min(height, HIGHEST)
    elif whole:
        height = page.tab.evaluate("document.documentElement.scrollHeight")
    chromium = page.context.new_cdp_session(page.tab)
    # Playwright itself does not support WebP, which takes half the size of PNG.
    taken = chromium.send(
        "Page.captureScreenshot",
        {
            "format": "webp",
            "quality": 90,
            "captureBeyondViewport": True,
            "clip": {"x": x, "y": y, "width": width, "height": height, "scale": 1},
        },
    )
    (folder / f"{name}.webp").write_bytes(base64.b64decode(taken["data"]))
    if page.complaints or page.hosts() != hosts:
        raise AssertionError(f"{name}: {page.complaints} {page.hosts()}")


def rehearsal(browser, demo, folder):
    """Takes a picture of the output of `rehearse` in a terminal."""
    command = ["rehearse", f"http://{demo.session}", *REHEARSAL]
    done = subprocess.run(
        [BIN / command[0], *command[1:]], stdout=subprocess.PIPE, timeout=10 * SOON, text=True, check=True
    )
    page = browser.page(width=900, height=100)
    shown = " ".join(command).replace(" --world", " \\\n    --world").replace(" --clients", " \\\n    --clients")
    page.tab.set_content(TERMINAL % html.escape(f"$ {shown}\n{done.stdout}"))
    shoot(page, folder, "rehearsal", set())
    page.close()


def pages(browser, demo, folder):
    """Takes pictures of the monitors and the viewer, once the charts are full."""
    demo.add("third", "The machine in the attic")
    fleet = browser.page(width=WIDTH, height=860)
    fleet.tab.goto(f"http://{demo.session}/monitor")
    expect(fleet.tab.locator("#servers .state.up")).to_have_count(3)
    wait(demo, HISTORY // 20)
    clients = [start(browser, demo, "Playground")]
    for at, world in enumerate(["Carousel", "Playground", "Carousel", "Playground", "Carousel"], start=2):
        wait(demo, at * HISTORY // 10)
        clients.append(start(browser, demo, world))
    wait(demo, 7 * HISTORY // 10)
    clients.pop(0).close()
    clients[0].tab.get_by_role("button", name="Pause", exact=True).click()
    demo.server_sh("stop", "third")
    wait(demo, 9 * HISTORY // 10)
    clients.pop(1).close()
    viewer = start(browser, demo, "Playground", width=WIDTH, height=860)
    wait(demo, HISTORY)
    shoot(viewer, folder, "viewer", {"localhost"})
    machine = browser.page(width=WIDTH, height=860)
    machine.tab.goto(f"http://{demo.simulation}/monitor")
    expect(machine.tab.locator("#simulations td[data-label=CPU]").first).to_contain_text("%")
    shoot(machine, folder, "simulation-monitor", {"localhost"})
    expect(fleet.tab.locator("#servers .state.down")).to_have_count(1)
    shoot(fleet, folder, "session-monitor", {"localhost"})
    for one in [viewer, *clients]:
        one.close()


def a_class(browser, demo, folder):
    """Takes pictures of a teacher's pages: who is who, watching, stopping, announcing, a list of 200 on a phone."""
    hosts = {"localhost"}
    anna = start(browser, demo, "Playground", width=WIDTH, height=860, name="Anna")
    ben = start(browser, demo, "Carousel", height=860, name="Ben")
    others = browser.page(width=360, height=300)
    others.tab.goto(f"http://{demo.session}/viewer")
    start_all(others, NAMES[2:12], lambda name: None, PLAYGROUND)
    teacher = browser.page(width=WIDTH, height=860)
    teacher.sign_in(f"http://{demo.simulation}", PASSWORD)
    rows = teacher.tab.locator("#simulations tr")
    expect(rows).to_have_count(12)
    expect(rows.locator("[data-label=CPU]", has_text="%")).to_have_count(12)
    shoot(teacher, folder, "class", hosts, teacher.tab.locator("section:has(#simulations)"), margin=8)
    teacher.tab.get_by_label("Filter").fill("anna")
    row = teacher.tab.locator("#simulations tr:visible")
    expect(row).to_have_count(1)
    with teacher.context.expect_page() as opened:
        row.get_by_role("link", name="Watch").click()
    opened.value.close()
    watching = browser.page(width=WIDTH, height=760)
    watching.sign_in(f"http://{demo.simulation}", PASSWORD)
    watching.tab.goto(row.get_by_role("link", name="Watch").evaluate("link => link.href"))
    expect(watching.tab.locator("#state")).to_have_text("Watching")
    expect(anna.tab.locator("#watched")).to_be_visible()
    fleet = browser.page(width=WIDTH, height=860)
    fleet.sign_in(f"http://{demo.session}", PASSWORD)
    fleet.tab.get_by_label("Text for all open viewers").fill("Maintenance from noon on: please save your work.")
    fleet.tab.get_by_role("button", name="Announce").click()
    expect(anna.tab.locator("#announcement")).to_be_visible()
    shoot(watching, folder, "watch", hosts)
    shoot(anna, folder, "viewer-watched", hosts)
    watching.close()
    row.get_by_role("button", name="Stop").click()
    teacher.tab.get_by_label("Reason").fill("Please come to my desk")
    shoot(teacher, folder, "stop", hosts, teacher.tab.get_by_role("dialog"), margin=60)
    phone(browser, demo, folder, hosts)
    for one in [anna, ben, others, teacher, fleet]:
        one.close()


def phone(browser, demo, folder, hosts):
    """Takes a picture of the list of a large class, made of many copies of each row."""
    page = browser.page(width=390, height=844)
    page.sign_in(f"http://{demo.simulation}", PASSWORD)
    row = page.tab.locator("#simulations tr").first
    known = page.tab.locator("#simulations tr").evaluate_all(
        "rows => rows.map((row) => [row.dataset.key, row.innerHTML])"
    )
    many = []
    for number in range(200):
        key, html = known[number % len(known)]
        name = f"{key.rsplit('-', 1)[0]}-{number + 1}"
        many.append(
            {"key": name, "html": html.replace(key, name).replace(" at desk ", f" at desk {number // len(known) + 1}.")}
        )
    event = "data: " + json.dumps({"tables": {"simulations": many}}) + "\n\n"
    page.tab.route("**/events", lambda route: route.fulfill(content_type="text/event-stream", body=event))
    page.tab.reload()
    expect(row).to_be_visible()
    expect(page.tab.locator("#simulations tr")).to_have_count(200)
    page.tab.get_by_label("Filter").fill("dora")
    page.tab.evaluate("document.querySelector('section:has(#simulations)').scrollIntoView()")
    # After scrolling, the new content is drawn in the next frame.
    page.tab.evaluate("new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    shoot(page, folder, "phone", hosts, whole=False)
    page.close()


def main(folder, wanted):
    expect.set_options(timeout=1000 * SOON)
    takes = {"rehearsal": rehearsal, "pages": pages, "class": a_class}
    wanted = set(wanted or takes)
    assert wanted <= takes.keys(), wanted
    with Browser() as browser:
        if wanted != {"class"}:
            with Demo() as demo:
                demo.add("second", "The machine in the cellar")
                for name in ["rehearsal", "pages"]:
                    if name in wanted:
                        takes[name](browser, demo, folder)
        if "class" in wanted:
            more = {"adminPassword": PASSWORD}
            with Demo(more, {**more, "maxConnections": 14}) as demo:
                a_class(browser, demo, folder)


main(pathlib.Path(sys.argv[1]).resolve(), sys.argv[2:])
