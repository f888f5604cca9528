"""What commands do: run an estimation or a prediction into a result folder.

Sits outside of the library proper: nothing in it is imported by shape, contact, belief or
predict.
"""
