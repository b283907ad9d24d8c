"""A class: its students, and one page that starts the simulations of all students who need no page of their own."""

NAMES = [
    "anna",
    "ben",
    "chloe",
    "dora",
    "emil",
    "fay",
    "gus",
    "hana",
    "ivan",
    "jane",
    "kofi",
    "lena",
    "milo",
    "nora",
    "omar",
    "pia",
    "quinn",
    "rosa",
    "sami",
    "tess",
    "uma",
    "vera",
    "will",
    "xena",
    "yara",
    "zeno",
    "amir",
    "bela",
    "carl",
    "dana",
]
# Run in a page: requests a simulation server, starts a world there, and keeps the connection open.
START = """
    async ([world, name]) => {
      const server = await (await fetch(`session?url=${world}`)).text();
      const socket = new WebSocket(`${server}/client`);
      const heard = new Promise((resolve, reject) => {
        socket.onmessage = ({ data }) => {
          if (data.startsWith('webots:'))
            resolve(data.slice('webots:'.length));
          else if (data.startsWith('loading: Error:'))
            reject(data);
        };
        setTimeout(() => reject(`${name} waits in vain`), 60_000);
        socket.onclose = ({ code }) => reject(`${name} was left: ${code}`);
      });
      heard.catch(() => {});
      (window.simulations ??= []).push(heard);
      await new Promise((resolve, reject) => {
        socket.onopen = resolve;
        socket.onerror = () => reject(`${name} is not let in`);
      });
      socket.send(JSON.stringify({ start: { url: world, name } }));
    }"""


def start_all(page, names, become, world):
    """Starts a simulation for each of these names; `become` signs in as another user.

    Returns the URLs of the streams.
    """
    for name in names:
        become(name)
        page.tab.evaluate(START, [world, label(name)])
    return page.tab.evaluate("Promise.all(simulations)")


def label(name):
    """The display name of a student without a page of their own."""
    return f"{name.title()} at desk {1 + NAMES.index(name)}"
