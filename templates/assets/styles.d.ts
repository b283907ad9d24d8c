// The style sheets of the element, which the server makes a module from: `theme.css` and `simulation.css`.

export const styles: string;
