"""``nnode check`` in a checkout; ``--help`` shows what it does, examples and options."""

from nnode.app.commands.check import main

if __name__ == "__main__":
    main()
