"""Values at the doors: arguments of public functions, and fields of files, checked and converted by their annotations.

The classes and signatures are the schema; nothing is written twice. ``calls`` checks arguments, ``records`` converts
between JSON or TOML and dataclasses, ``kinds`` says in words what a type expects, and ``annotations`` finds the types.
"""
