/* Which of hundreds of sensed discs lie near the robot. The twin is safety/barriers/disc_selection.py, and answers with
   its errors for rows of other kinds, for numbers that are not finite and for radii below 0: here that is None. */

/* The numbers of a row, a tuple of so many floats; 0: it is something else. */
static int floats_in(PyObject *row, Py_ssize_t width, double *out)
{
    if (!PyTuple_CheckExact(row) || PyTuple_GET_SIZE(row) != width)
        return 0;
    for (Py_ssize_t i = 0; i < width; i++) {
        PyObject *item = PyTuple_GET_ITEM(row, i);
        if (!PyFloat_CheckExact(item))
            return 0;
        out[i] = PyFloat_AS_DOUBLE(item);
    }
    return 1;
}

static int append(PyObject *list, PyObject *item)
{
    const int good = item && PyList_Append(list, item) == 0;
    Py_XDECREF(item);
    return good;
}

/* discs_near(rows, x, y, within, room) -> (indices, discs), or None. */
static PyObject *selection_discs_near(PyObject *module, PyObject *args)
{
    PyObject *rows;
    double x, y, within, room, total = 0.0, row[3];
    (void)module;
    if (!PyArg_ParseTuple(args, "Odddd", &rows, &x, &y, &within, &room))
        return NULL;
    if (!PyTuple_CheckExact(rows))
        Py_RETURN_NONE;
    PyObject *kept = PyList_New(0), *discs = PyList_New(0);
    int good = kept && discs, usual = 1;
    for (Py_ssize_t i = 0; good && usual && i < PyTuple_GET_SIZE(rows); i++) {
        usual = floats_in(PyTuple_GET_ITEM(rows, i), 3, row) && row[2] >= 0.0;
        if (!usual)
            break;
        total += row[0] + row[1] + row[2];
        const double reach = row[2] + room, apart_x = row[0] - x, apart_y = row[1] - y, limit = within + reach;
        if (apart_x * apart_x + apart_y * apart_y < limit * limit)
            good = append(kept, PyLong_FromSsize_t(i)) &&
                   append(discs, Py_BuildValue("(OOd)", PyTuple_GET_ITEM(PyTuple_GET_ITEM(rows, i), 0),
                                               PyTuple_GET_ITEM(PyTuple_GET_ITEM(rows, i), 1), reach));
    }
    if (good && usual && total - total == 0.0)
        return Py_BuildValue("(NN)", kept, discs);
    Py_XDECREF(kept);
    Py_XDECREF(discs);
    if (!good)
        return NULL;
    Py_RETURN_NONE;
}

/* fastest(rows, width) -> the largest speed, the last of `width` numbers, or None. */
static PyObject *selection_fastest(PyObject *module, PyObject *args)
{
    PyObject *rows;
    int width;
    double fastest = 0.0, total = 0.0, row[8];
    (void)module;
    if (!PyArg_ParseTuple(args, "Oi", &rows, &width))
        return NULL;
    if (!PyTuple_CheckExact(rows) || width < 3 || width > 8)
        Py_RETURN_NONE;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(rows); i++) {
        if (!floats_in(PyTuple_GET_ITEM(rows, i), width, row) || !(row[2] >= 0.0) || !(row[width - 1] >= 0.0))
            Py_RETURN_NONE;
        for (int column = 0; column < width; column++)
            total += row[column];
        fastest = row[width - 1] > fastest ? row[width - 1] : fastest;
    }
    if (total - total != 0.0)
        Py_RETURN_NONE;
    return PyFloat_FromDouble(fastest);
}
