"""Message types, topics, requests and their encoding.

``messages`` defines the message types, ``topics`` the table of topics, ``requests`` the questions and answers of
services, ``codec`` the strict conversion to and from msgpack. ``service_info`` describes a process for recordings and
Read ``messages.py`` and ``topics.py`` first.
"""
