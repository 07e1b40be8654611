"""``python -m nnode.laws`` prints the catalogue."""

from nnode.app.laws import main

if __name__ == "__main__":
    main()
