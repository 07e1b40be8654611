"""``nnode prepare_data`` in a checkout; ``--help`` shows what it does, examples and options."""

from nnode.app.commands.prepare_data import main

if __name__ == "__main__":
    main()
