"""``nnode plot_forces`` in a checkout; ``--help`` shows what it does, examples and options."""

from nnode.app.commands.plot_forces import main

if __name__ == "__main__":
    main()
