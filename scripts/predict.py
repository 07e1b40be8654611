"""``nnode predict`` in a checkout; ``--help`` shows what it does, examples and options."""

from nnode.app.commands.predict import main

if __name__ == "__main__":
    main()
