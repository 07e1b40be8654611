"""``nnode simulate`` in a checkout; ``--help`` shows what it does, examples and options."""

from nnode.app.commands.simulate import main

if __name__ == "__main__":
    main()
