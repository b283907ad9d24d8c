"""A class: who is in it, and those of it who need no page of their own, because one page starts all of their simulations."""

NAMES = [
    "anna", "ben", "chloe", "dora", "emil", "fay", "gus", "hana", "ivan", "jane", "kofi", "lena", "milo", "nora", "omar", "pia", "quinn",
    "rosa", "sami", "tess", "uma", "vera", "will", "xena", "yara", "zeno", "amir", "bela", "carl", "dana"]
# What a page does that shows nothing: it asks for a simulation server, starts a world there, and stays.
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
    """Starts a simulation for each of these names; `become` makes the browser somebody else. Gives back their streams."""
    for name in names:
        become(name)
        page.tab.evaluate(START, [world, label(name)])
    return page.tab.evaluate("Promise.all(simulations)")


def label(name):
    """What somebody who is on no page of the viewer calls itself."""
    return f"{name.title()} at desk {1 + NAMES.index(name)}"
