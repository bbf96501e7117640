/* The Python side: Step (a model's step and tangent), Networks (f and g of learned ones), Rows (barriers of one
   scene), and Search (one decision). */

static double *doubles(PyObject *given, Py_ssize_t wanted, double *out, const char *what)
{
    PyObject *items = PySequence_Fast(given, what);
    if (!items)
        return NULL;
    const Py_ssize_t count = PySequence_Fast_GET_SIZE(items);
    if (count != wanted) {
        PyErr_Format(PyExc_ValueError, "%s: got %zd numbers, wanted %zd", what, count, wanted);
        Py_DECREF(items);
        return NULL;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        /* the conversion of another number than a float may run Python, which may shorten the list */
        PyObject *item = i < PySequence_Fast_GET_SIZE(items) ? PySequence_Fast_GET_ITEM(items, i) : Py_None;
        if (PyFloat_CheckExact(item)) {
            out[i] = PyFloat_AS_DOUBLE(item);
            continue;
        }
        Py_INCREF(item);
        out[i] = PyFloat_AsDouble(item);
        Py_DECREF(item);
        if (out[i] == -1.0 && PyErr_Occurred()) {
            Py_DECREF(items);
            return NULL;
        }
    }
    Py_DECREF(items);
    return out;
}

static PyObject *list_of(const double *values, Py_ssize_t count)
{
    PyObject *list = PyList_New(count);
    for (Py_ssize_t i = 0; list && i < count; i++) {
        PyObject *value = PyFloat_FromDouble(values[i]);
        if (!value) {
            Py_CLEAR(list);
            break;
        }
        PyList_SET_ITEM(list, i, value);
    }
    return list;
}

static PyObject *tuple_of(const double *values, Py_ssize_t count)
{
    PyObject *tuple = PyTuple_New(count);
    for (Py_ssize_t i = 0; tuple && i < count; i++) {
        PyObject *value = PyFloat_FromDouble(values[i]);
        if (!value) {
            Py_CLEAR(tuple);
            break;
        }
        PyTuple_SET_ITEM(tuple, i, value);
    }
    return tuple;
}

static PyObject *table_of(const double *values, Py_ssize_t rows, Py_ssize_t columns, int tuples)
{
    PyObject *table = PyList_New(rows);
    for (Py_ssize_t i = 0; table && i < rows; i++) {
        PyObject *row = tuples ? tuple_of(values + i * columns, columns) : list_of(values + i * columns, columns);
        if (!row) {
            Py_CLEAR(table);
            break;
        }
        PyList_SET_ITEM(table, i, row);
    }
    return table;
}

static int check_count(Py_ssize_t got, Py_ssize_t wanted)
{
    if (got == wanted)
        return 1;
    PyErr_Format(PyExc_TypeError, "got %zd arguments, wanted %zd", got, wanted);
    return 0;
}

/* ---- Step ---- */

typedef struct {
    PyObject_HEAD
    model_step own;
    double *k;
    PyObject *library;
} Step;

static int step_init(Step *self, PyObject *args, PyObject *kw)
{
    unsigned long long step, tangent;
    PyObject *constants, *library;
    int states, actions, latents;
    (void)kw;
    if (!PyArg_ParseTuple(args, "KKO!iiiO", &step, &tangent, &PyList_Type, &constants, &states, &actions, &latents,
                          &library))
        return -1;
    if (self->k || states < 1 || states > MOST_STATES || actions < 0 || actions > 64 || latents < 0 || latents > 256) {
        PyErr_SetString(PyExc_ValueError, "a step of another size");
        return -1;
    }
    self->k = PyMem_Malloc(sizeof(double) * (size_t)(PyList_GET_SIZE(constants) + 1));
    if (!self->k || !doubles(constants, PyList_GET_SIZE(constants), self->k, "constants"))
        return -1;
    self->own.step = (step_function *)(uintptr_t)step;
    self->own.tangent = (tangent_function *)(uintptr_t)tangent;
    self->own.k = self->k;
    self->own.states = states, self->own.actions = actions, self->own.latents = latents;
    Py_INCREF(library);
    self->library = library;
    return 0;
}

static void step_free(Step *self)
{
    PyMem_Free(self->k);
    Py_XDECREF(self->library);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static int step_inputs(Step *self, PyObject *const *args, Py_ssize_t count, double *s, double *a, double *z, double *t)
{
    if (!check_count(count, 4) || !self->k)
        return 0;
    if (!doubles(args[0], self->own.states, s, "state") || !doubles(args[1], self->own.actions, a, "action") ||
        !doubles(args[2], self->own.latents, z, "latent"))
        return 0;
    *t = PyFloat_AsDouble(args[3]);
    return !(*t == -1.0 && PyErr_Occurred());
}

static PyObject *step_step(Step *self, PyObject *const *args, Py_ssize_t count)
{
    double s[MOST_STATES], a[64], z[256], t, out[MOST_STATES];
    if (!step_inputs(self, args, count, s, a, z, &t))
        return NULL;
    clear_flags();
    self->own.step(s, a, z, &t, self->k, out);
    if (odd_numbers())
        return PyErr_Format(PyExc_ArithmeticError, "numbers that Python's math refuses");
    return list_of(out, self->own.states);
}

static PyObject *step_tangent(Step *self, PyObject *const *args, Py_ssize_t count)
{
    double s[MOST_STATES], a[64], z[256], t, out[MOST_STATES], g[MOST_STATES * 64];
    if (!step_inputs(self, args, count, s, a, z, &t))
        return NULL;
    clear_flags();
    self->own.tangent(s, a, z, &t, self->k, out, g);
    if (odd_numbers())
        return PyErr_Format(PyExc_ArithmeticError, "numbers that Python's math refuses");
    return Py_BuildValue("(NN)", list_of(out, self->own.states), table_of(g, self->own.states, self->own.actions, 0));
}

static PyMethodDef step_methods[] = {
    {"step", (PyCFunction)(void (*)(void))step_step, METH_FASTCALL,
     "step(state, action, latent, time) -> the next state (states,). Raises ArithmeticError for odd numbers."},
    {"tangent", (PyCFunction)(void (*)(void))step_tangent, METH_FASTCALL,
     "tangent(state, action, latent, time) -> the next state, and its slopes in the action (states, actions)."},
    {NULL, NULL, 0, NULL}};

static PyTypeObject StepType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "safedpa_kernel.Step", .tp_basicsize = sizeof(Step),
    .tp_flags = Py_TPFLAGS_DEFAULT, .tp_new = PyType_GenericNew, .tp_init = (initproc)step_init,
    .tp_dealloc = (destructor)step_free, .tp_methods = step_methods,
    .tp_doc = "A model's step and its tangent in the action, compiled."};

/* ---- Networks ---- */

enum { MOST_PRODUCTS = 64, MOST_TURNED = 8, MOST_FEATURES = 320 };

typedef struct {
    PyObject_HEAD
    features_function *features;
    double *k;
    network_product product[MOST_PRODUCTS];
    int products, states, actions, latents, seen, turns, turned[MOST_TURNED][2], wide;
    void *gemv;
    float *input;
    const float *output;
    PyObject *owner;
    double known[MOST_STATES * 65], last[MOST_STATES + 256]; /* f and g, and of which state and latent */
    int is_known;
} Networks;

static float *floats_of(PyObject *array, Py_ssize_t *count)
{
    Py_buffer view;
    if (PyObject_GetBuffer(array, &view, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS) < 0)
        return NULL;
    float *found = view.format && !strcmp(view.format, "f") ? view.buf : NULL;
    *count = view.len / (Py_ssize_t)sizeof(float);
    PyBuffer_Release(&view); /* the owner keeps the array */
    if (!found)
        PyErr_SetString(PyExc_TypeError, "networks: wanted contiguous arrays of float32");
    return found;
}

/* (a, x, y, what is cut or None) */
static int add_product(Networks *self, PyObject *task)
{
    PyObject *a, *x, *y, *cut;
    if (!PyArg_ParseTuple(task, "OOOO", &a, &x, &y, &cut))
        return 0;
    network_product *p = &self->product[self->products];
    Py_ssize_t numbers, rows, columns, cuts = 0;
    p->a = floats_of(a, &numbers);
    p->x = p->a ? floats_of(x, &rows) : NULL;
    p->y = p->x ? floats_of(y, &columns) : NULL;
    p->first = p->y && cut != Py_None ? floats_of(cut, &cuts) : NULL;
    if (PyErr_Occurred())
        return 0;
    if (numbers != rows * columns || rows > MOST_INPUTS || columns > 1000000) {
        PyErr_SetString(PyExc_ValueError, "networks: layers of other sizes");
        return 0;
    }
    p->rows = (int)rows, p->columns = (int)columns, p->cut = (int)cuts;
    self->products++;
    return 1;
}

/* (features, constants, (states, actions, latents, seen), turned, products, input, output, gemv, wide, owner) */
static int networks_init(Networks *self, PyObject *args, PyObject *kw)
{
    unsigned long long features, gemv;
    PyObject *constants, *turned, *products, *input, *output, *owner;
    (void)kw;
    if (!PyArg_ParseTuple(args, "KO!(iiii)O!O!OOKpO", &features, &PyList_Type, &constants, &self->states,
                          &self->actions, &self->latents, &self->seen, &PyTuple_Type, &turned, &PyList_Type, &products,
                          &input, &output, &gemv, &self->wide, &owner))
        return -1;
    const Py_ssize_t turns = PyTuple_GET_SIZE(turned), count = PyList_GET_SIZE(products);
    const int known = self->states * (self->actions + 1);
    Py_ssize_t entries, results;
    if (self->owner || self->states < 1 || self->states > MOST_STATES || self->actions < 0 || self->actions > 64 ||
        self->latents < 0 || self->latents > 256 || self->seen < 0 || self->seen > MOST_FEATURES ||
        turns > MOST_TURNED || count > MOST_PRODUCTS) {
        PyErr_SetString(PyExc_ValueError, "networks of another size");
        return -1;
    }
    self->input = floats_of(input, &entries);
    self->output = self->input ? floats_of(output, &results) : NULL;
    self->k = PyMem_Malloc(sizeof(double) * (size_t)(PyList_GET_SIZE(constants) + 1));
    if (!self->output || !self->k || !doubles(constants, PyList_GET_SIZE(constants), self->k, "constants"))
        return -1;
    if (entries < self->seen + self->latents || results != known) {
        PyErr_SetString(PyExc_ValueError, "networks of another size");
        return -1;
    }
    for (Py_ssize_t i = 0; i < turns; i++) {
        int *pair = self->turned[i];
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(turned, i), "ii", pair, pair + 1))
            return -1;
        if (pair[0] < 0 || pair[0] >= self->states || pair[1] < 0 || pair[1] >= self->states) {
            PyErr_SetString(PyExc_ValueError, "networks: a vector of other entries");
            return -1;
        }
    }
    self->turns = (int)turns;
    for (Py_ssize_t i = 0; i < count; i++)
        if (!add_product(self, PyList_GET_ITEM(products, i)))
            return -1;
    self->features = (features_function *)(uintptr_t)features;
    self->gemv = (void *)(uintptr_t)gemv;
    Py_INCREF(owner);
    self->owner = owner;
    return 0;
}

static void networks_free(Networks *self)
{
    PyMem_Free(self->k);
    Py_XDECREF(self->owner);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* f and g at a state and a latent; NULL: numbers that Python and NumPy have to judge. */
static const double *known_of(Networks *self, const double *state, const double *latent)
{
    const size_t states = sizeof(double) * (size_t)self->states, latents = sizeof(double) * (size_t)self->latents;
    if (self->is_known && !memcmp(self->last, state, states) && !memcmp(self->last + self->states, latent, latents))
        return self->known;
    double seen[MOST_FEATURES + 2];
    self->is_known = 0;
    clear_flags();
    self->features(state, self->k, seen);
    for (int i = 0; i < self->seen; i++)
        self->input[i] = (float)seen[i];
    for (int i = 0; i < self->latents; i++)
        self->input[self->seen + i] = (float)latent[i];
    for (int i = 0; i < self->products; i++)
        multiply(&self->product[i], self->gemv, self->wide);
    const int width = self->actions + 1;
    double rows[MOST_STATES * 65];
    for (int i = 0; i < self->states * width; i++)
        rows[i] = (double)self->output[i];
    const double cosine = seen[self->seen], sine = seen[self->seen + 1];
    for (int i = 0; i < self->turns; i++) {
        double *x = rows + self->turned[i][0] * width, *y = rows + self->turned[i][1] * width;
        for (int column = 0; column < width; column++) {
            const double along = x[column], across = y[column];
            x[column] = cosine * along - sine * across;
            y[column] = sine * along + cosine * across;
        }
    }
    for (int i = 0; i < self->states; i++) {
        self->known[i] = rows[i * width];
        memcpy(self->known + self->states + i * self->actions, rows + i * width + 1,
               sizeof(double) * (size_t)self->actions);
    }
    if (odd_numbers() || !all_finite(self->known, self->states * width))
        return NULL;
    memcpy(self->last, state, states);
    memcpy(self->last + self->states, latent, latents);
    self->is_known = 1;
    return self->known;
}

static PyObject *networks_known(Networks *self, PyObject *const *args, Py_ssize_t count)
{
    double state[MOST_STATES], latent[256];
    if (!check_count(count, 2) || !self->owner || !doubles(args[0], self->states, state, "state") ||
        !doubles(args[1], self->latents, latent, "latent"))
        return NULL;
    const double *known = known_of(self, state, latent);
    if (!known)
        return PyErr_Format(PyExc_ArithmeticError, "numbers that Python's math refuses");
    return list_of(known, self->states * (self->actions + 1));
}

/* multiply(product, sparse): one product of the arrays as they are, and from now on in this way. */
static PyObject *networks_multiply(Networks *self, PyObject *args)
{
    int which, sparse;
    if (!PyArg_ParseTuple(args, "ip", &which, &sparse))
        return NULL;
    if (which < 0 || which >= self->products || (sparse ? !has_sparse_product() : !self->gemv))
        return PyErr_Format(PyExc_ValueError, "networks: no such product");
    self->is_known = 0;
    self->product[which].sparse = sparse;
    multiply(&self->product[which], self->gemv, self->wide);
    Py_RETURN_NONE;
}

static PyMethodDef networks_methods[] = {
    {"known", (PyCFunction)(void (*)(void))networks_known, METH_FASTCALL,
     "known(state, latent) -> f (states,), then g row by row. Raises ArithmeticError for odd numbers."},
    {"multiply", (PyCFunction)networks_multiply, METH_VARARGS, "See networks/compiled.py."},
    {NULL, NULL, 0, NULL}};

static PyTypeObject NetworksType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "safedpa_kernel.Networks", .tp_basicsize = sizeof(Networks),
    .tp_flags = Py_TPFLAGS_DEFAULT, .tp_new = PyType_GenericNew, .tp_init = (initproc)networks_init,
    .tp_dealloc = (destructor)networks_free, .tp_methods = networks_methods,
    .tp_doc = "f and g of learned networks at one state, with the bits of NumPy's products."};

/* ---- Rows ---- */

enum { MOST_GROUPS = 32 };

typedef struct {
    PyObject_HEAD
    barrier_rows own;
    double *data; /* constants, kept values and items in one block */
    const double *items[MOST_GROUPS];
    int counts[MOST_GROUPS];
    PyObject *kind, *shared, *each, *twin;
} Rows;

static int copy_table(PyObject *table, Py_ssize_t wanted, int width, double **place)
{
    PyObject *items = PySequence_Fast(table, "items");
    if (!items)
        return -1;
    for (Py_ssize_t i = 0; i < wanted; i++) {
        PyObject *item = i < PySequence_Fast_GET_SIZE(items) ? PySequence_Fast_GET_ITEM(items, i) : Py_None;
        Py_INCREF(item);
        const int good = doubles(item, width, *place, "item") != NULL;
        Py_DECREF(item);
        if (!good) {
            Py_DECREF(items);
            return -1;
        }
        *place += width;
    }
    Py_DECREF(items);
    return 0;
}

/* kind: (scene, h, slopes, bound, constants, states, kept, groups, class of the twin, library), a group being (owner or
   not, shared numbers, numbers of an item, rows of an item). */
static int rows_init(Rows *self, PyObject *args, PyObject *kw)
{
    PyObject *kind, *shared, *each, *constants, *groups, *twin, *library;
    unsigned long long scene, h, slopes, bound;
    int states, kept;
    (void)kw;
    if (!PyArg_ParseTuple(args, "O!O!O!", &PyTuple_Type, &kind, &PyList_Type, &shared, &PyList_Type, &each))
        return -1;
    if (!PyArg_ParseTuple(kind, "KKKKO!iiO!OO", &scene, &h, &slopes, &bound, &PyList_Type, &constants, &states, &kept,
                          &PyTuple_Type, &groups, &twin, &library))
        return -1;
    const Py_ssize_t count = PyTuple_GET_SIZE(groups);
    if (self->data || count > MOST_GROUPS || count != PyList_GET_SIZE(shared) || count != PyList_GET_SIZE(each) ||
        states < 1 || states > MOST_STATES) {
        PyErr_SetString(PyExc_ValueError, "barriers of another size");
        return -1;
    }
    Py_ssize_t size = PyList_GET_SIZE(constants) + kept + 1, shared_size = 0;
    int widths[MOST_GROUPS], owners[MOST_GROUPS], shared_widths[MOST_GROUPS];
    self->own.rows = 0;
    for (Py_ssize_t g = 0; g < count; g++) {
        int results;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(groups, g), "iiii", owners + g, shared_widths + g, widths + g, &results))
            return -1;
        const Py_ssize_t items = PySequence_Size(PyList_GET_ITEM(each, g));
        if (items < 0)
            return -1;
        if (items > 1000000 || widths[g] < 0 || results < 0) {
            PyErr_SetString(PyExc_ValueError, "barriers of another size");
            return -1;
        }
        size += items * widths[g];
        shared_size += owners[g] ? shared_widths[g] : 0;
        self->counts[g] = (int)items;
        self->own.rows += (int)items * results;
    }
    self->data = PyMem_Malloc(sizeof(double) * (size_t)(size + shared_size));
    if (!self->data) {
        PyErr_NoMemory();
        return -1;
    }
    double *place = self->data, *values;
    if (!doubles(constants, PyList_GET_SIZE(constants), place, "constants"))
        return -1;
    self->own.k = place;
    place += PyList_GET_SIZE(constants);
    double *kept_values = place;
    place += kept;
    values = place;
    for (Py_ssize_t g = 0; g < count; g++)
        if (owners[g]) {
            if (!doubles(PyList_GET_ITEM(shared, g), shared_widths[g], place, "shared"))
                return -1;
            place += shared_widths[g];
        }
    for (Py_ssize_t g = 0; g < count; g++) {
        PyObject *table = PyList_GET_ITEM(each, g);
        self->items[g] = place;
        if (PySequence_Size(table) != self->counts[g] || copy_table(table, self->counts[g], widths[g], &place) < 0) {
            if (!PyErr_Occurred())
                PyErr_SetString(PyExc_ValueError, "items that change");
            return -1;
        }
    }
    clear_flags();
    ((scene_function *)(uintptr_t)scene)(values, self->own.k, kept_values);
    if (odd_numbers()) {
        PyErr_SetString(PyExc_ArithmeticError, "numbers that Python's math refuses");
        return -1;
    }
    self->own.kept = kept_values;
    self->own.h = (h_function *)(uintptr_t)h;
    self->own.slopes = (slopes_function *)(uintptr_t)slopes;
    self->own.bound = (bound_function *)(uintptr_t)bound;
    self->own.items = self->items, self->own.counts = self->counts, self->own.states = states;
    Py_INCREF(kind), Py_INCREF(shared), Py_INCREF(each);
    self->kind = kind, self->shared = shared, self->each = each;
    return 0;
}

static void rows_free(Rows *self)
{
    PyMem_Free(self->data);
    Py_XDECREF(self->kind), Py_XDECREF(self->shared), Py_XDECREF(self->each), Py_XDECREF(self->twin);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* What Python answers for odd numbers, with its exceptions. */
static PyObject *ask_twin(Rows *self, const char *method, PyObject *const *args, Py_ssize_t count)
{
    if (!self->twin) {
        self->twin = PyObject_CallFunctionObjArgs(PyTuple_GET_ITEM(self->kind, 8), self->shared, self->each, NULL);
        if (!self->twin)
            return NULL;
    }
    PyObject *called = PyObject_GetAttrString(self->twin, method);
    PyObject *found = called ? PyObject_Vectorcall(called, args, (size_t)count, NULL) : NULL;
    Py_XDECREF(called);
    return found;
}

static PyObject *rows_h(Rows *self, PyObject *const *args, Py_ssize_t count)
{
    double s[MOST_STATES], few[128];
    if (!check_count(count, 1) || !self->kind || !doubles(args[0], self->own.states, s, "state"))
        return NULL;
    double *out = self->own.rows <= 128 ? few : PyMem_Malloc(sizeof(double) * (size_t)self->own.rows);
    if (!out)
        return PyErr_NoMemory();
    clear_flags();
    self->own.h(s, self->own.kept, self->own.k, self->items, self->counts, out);
    PyObject *found = odd_numbers() ? ask_twin(self, "h_floats", args, count) : list_of(out, self->own.rows);
    if (out != few)
        PyMem_Free(out);
    return found;
}

/* The slopes (rows, states) of the rows asked for; NULL and no error: odd numbers. */
static double *slopes_of(Rows *self, PyObject *state, PyObject *rows, Py_ssize_t *count)
{
    double s[MOST_STATES];
    if (!doubles(state, self->own.states, s, "state"))
        return NULL;
    PyObject *wanted = PySequence_Fast(rows, "rows");
    if (!wanted)
        return NULL;
    *count = PySequence_Fast_GET_SIZE(wanted);
    double *out = PyMem_Malloc(sizeof(double) * (size_t)(*count * self->own.states + 1));
    int *indices = PyMem_Malloc(sizeof(int) * (size_t)(*count + 1));
    int good = out && indices;
    for (Py_ssize_t i = 0; i < *count && good; i++) {
        const long row = PyLong_AsLong(PySequence_Fast_GET_ITEM(wanted, i));
        good = row >= 0 && row < self->own.rows;
        indices[i] = (int)row;
    }
    Py_DECREF(wanted);
    if (!good) {
        if (!PyErr_Occurred())
            PyErr_SetString(PyExc_IndexError, "rows: got one that is not there");
    } else {
        clear_flags();
        self->own.slopes(s, self->own.kept, self->own.k, self->items, self->counts, indices, (int)*count, out);
        good = !odd_numbers();
    }
    PyMem_Free(indices);
    if (good)
        return out;
    PyMem_Free(out);
    return NULL;
}

static PyObject *rows_grad(Rows *self, PyObject *const *args, Py_ssize_t count)
{
    Py_ssize_t rows;
    if (!check_count(count, 2) || !self->kind)
        return NULL;
    double *slopes = slopes_of(self, args[0], args[1], &rows);
    if (!slopes)
        return PyErr_Occurred() ? NULL : ask_twin(self, "grad_h_floats", args, count);
    PyObject *found = table_of(slopes, rows, self->own.states, 1);
    PyMem_Free(slopes);
    return found;
}

static PyObject *rows_lie(Rows *self, PyObject *const *args, Py_ssize_t count)
{
    Py_ssize_t rows;
    if (!check_count(count, 4) || !self->kind)
        return NULL;
    const int states = self->own.states;
    const Py_ssize_t given = PySequence_Size(args[1]);
    if (given < 0)
        return NULL;
    if (given != states)
        return PyErr_Format(PyExc_ValueError, "h has slopes of %d states, the model of %zd", states, given);
    PyObject *first = PySequence_GetItem(args[1], 0);
    const Py_ssize_t actions = first ? PySequence_Size(first) : -1;
    Py_XDECREF(first);
    if (actions < 0)
        return NULL;
    double *g = PyMem_Malloc(sizeof(double) * (size_t)(states * actions + 1));
    double *slopes = g ? slopes_of(self, args[0], args[3], &rows) : NULL, *place = g;
    PyObject *found = NULL;
    if (!g)
        PyErr_NoMemory();
    else if (!slopes)
        found = PyErr_Occurred() ? NULL : ask_twin(self, "lie_derivative_floats", args, count);
    else if (copy_table(args[1], states, (int)actions, &place) == 0) {
        double *out = PyMem_Malloc(sizeof(double) * (size_t)(rows * actions + 1));
        for (Py_ssize_t i = 0; out && i < rows; i++)
            for (Py_ssize_t column = 0; column < actions; column++) {
                double total = 0.0;
                for (int s = 0; s < states; s++)
                    total += slopes[i * states + s] * g[s * actions + column];
                out[i * actions + column] = total;
            }
        found = out ? table_of(out, rows, actions, 0) : PyErr_NoMemory();
        PyMem_Free(out);
    }
    PyMem_Free(slopes);
    PyMem_Free(g);
    return found;
}

static PyObject *rows_bound(Rows *self, PyObject *const *args, Py_ssize_t count)
{
    double s[MOST_STATES], out[MOST_STATES];
    if (!check_count(count, 1) || !self->kind)
        return NULL;
    if (!self->own.bound)
        Py_RETURN_NONE;
    if (!doubles(args[0], self->own.states, s, "state"))
        return NULL;
    clear_flags();
    self->own.bound(s, self->own.kept, self->own.k, out);
    return odd_numbers() ? ask_twin(self, "grad_bound", args, count) : tuple_of(out, self->own.states);
}

static PyMethodDef rows_methods[] = {
    {"h_floats", (PyCFunction)(void (*)(void))rows_h, METH_FASTCALL, "h (rows,) at a state."},
    {"grad_h_floats", (PyCFunction)(void (*)(void))rows_grad, METH_FASTCALL, "d(h)/d(state) of some rows."},
    {"lie_derivative_floats", (PyCFunction)(void (*)(void))rows_lie, METH_FASTCALL, "d(h)/d(action) of some rows."},
    {"grad_bound", (PyCFunction)(void (*)(void))rows_bound, METH_FASTCALL, "What no slope exceeds, or None."},
    {NULL, NULL, 0, NULL}};

static PyTypeObject RowsType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "safedpa_kernel.Rows", .tp_basicsize = sizeof(Rows),
    .tp_flags = Py_TPFLAGS_DEFAULT, .tp_new = PyType_GenericNew, .tp_init = (initproc)rows_init,
    .tp_dealloc = (destructor)rows_free, .tp_methods = rows_methods,
    .tp_doc = "h of all barriers of one scene, and its slopes, compiled: as the classes of equations.scalar_rows."};

/* ---- Rollout ---- */

typedef struct {
    PyObject_HEAD
    barrier_rows own;
    rollout_functions functions;
    PyObject *owner;
} Rollout;

/* (run, differences, gradient or 0, address of the arrays, rows, states, owner of the arrays) */
static int rollout_init(Rollout *self, PyObject *args, PyObject *kw)
{
    unsigned long long run, differences, gradient, call;
    PyObject *owner;
    (void)kw;
    if (!PyArg_ParseTuple(args, "KKKKiiO", &run, &differences, &gradient, &call, &self->own.rows, &self->own.states,
                          &owner))
        return -1;
    if (self->owner || self->own.states < 1 || self->own.states > MOST_STATES) {
        PyErr_SetString(PyExc_ValueError, "a rollout of another size");
        return -1;
    }
    self->functions.run = (int (*)(const rollout_call *, int))(uintptr_t)run;
    self->functions.differences = (int (*)(const rollout_call *, int, int))(uintptr_t)differences;
    self->functions.gradient = (int (*)(const rollout_call *, int, int))(uintptr_t)gradient;
    self->functions.call = (rollout_call *)(uintptr_t)call;
    self->own.rollout = &self->functions;
    Py_INCREF(owner);
    self->owner = owner;
    return 0;
}

static void rollout_free(Rollout *self)
{
    Py_XDECREF(self->owner);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyTypeObject RolloutType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "safedpa_kernel.Rollout", .tp_basicsize = sizeof(Rollout),
    .tp_flags = Py_TPFLAGS_DEFAULT, .tp_new = PyType_GenericNew, .tp_init = (initproc)rollout_init,
    .tp_dealloc = (destructor)rollout_free, .tp_doc = "A compiled rollout with the arrays of one thread."};

/* The barriers of Rows or of a Rollout; NULL for other objects. */
static const barrier_rows *barriers_of(PyObject *object)
{
    if (PyObject_TypeCheck(object, &RowsType) && ((Rows *)object)->kind)
        return &((Rows *)object)->own;
    if (PyObject_TypeCheck(object, &RolloutType) && ((Rollout *)object)->owner)
        return &((Rollout *)object)->own;
    return NULL;
}

/* ---- Search ---- */

typedef struct {
    PyObject_HEAD
    decision_settings set;
    decision d;
    Step *model;
    Networks *networks; /* of the decision in progress; the caller holds it */
    PyObject *rows; /* of the decision in progress */
    double *numbers;
    int size;
    solver_status status;
    PyObject *verdict_type, *passed, *corrected, *outside, *array_type, *from_buffer, *names, *margin, *remark;
    double *low[3], *high[3]; /* of state, nominal action and latent; NULL: any finite number */
    int range_size[3];
    double state[MOST_STATES], latent[256], known[MOST_STATES * (MOST_ACTIONS + 1)];
    unsigned char *at_once;
} Search;

static int search_init(Search *self, PyObject *args, PyObject *kw)
{
    PyObject *low, *high, *width, *weights, *model;
    (void)kw;
    if (!PyArg_ParseTuple(args, "OOOOdipO", &low, &high, &width, &weights, &self->set.eta, &self->set.rounds,
                          &self->set.affine, &model))
        return -1;
    const Py_ssize_t actions = PySequence_Size(low);
    if (actions < 1 || actions > MOST_ACTIONS || self->model) {
        PyErr_SetString(PyExc_ValueError, "a decision about other actions than one or two");
        return -1;
    }
    if (!doubles(low, actions, self->set.low, "low") || !doubles(high, actions, self->set.high, "high") ||
        !doubles(width, actions, self->set.width, "width") || !doubles(weights, actions, self->set.weight, "weights"))
        return -1;
    self->set.actions = (int)actions;
    if (model != Py_None) {
        if (!PyObject_TypeCheck(model, &StepType) || ((Step *)model)->own.actions != actions) {
            PyErr_SetString(PyExc_ValueError, "a step of other actions");
            return -1;
        }
        Py_INCREF(model);
        self->model = (Step *)model;
    }
    return 0;
}

static void search_free(Search *self)
{
    for (block *one = self->d.blocks, *next; one; one = next) {
        next = one->next;
        free(one);
    }
    PyMem_Free(self->numbers);
    PyMem_Free(self->at_once);
    for (int i = 0; i < 3; i++)
        PyMem_Free(self->low[i]);
    PyObject *const owned[] = {(PyObject *)self->model, self->rows, self->verdict_type, self->passed, self->corrected,
                               self->outside, self->array_type, self->from_buffer, self->names, self->margin,
                               self->remark};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; i++)
        Py_XDECREF(owned[i]);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* Arrays for so many rows. */
static int reserve(Search *self, int rows)
{
    if (rows <= self->size)
        return 1;
    const int size = rows + rows / 2 + 8, both = size + BOUNDS;
    double *numbers = PyMem_Realloc(self->numbers, sizeof(double) * (size_t)(size + both * (3 + MOST_Z + 1)));
    if (numbers)
        self->numbers = numbers;
    unsigned char *flags = PyMem_Realloc(self->at_once, (size_t)(size + 2 * both));
    if (flags)
        self->at_once = flags;
    if (!numbers || !flags) {
        self->size = 0; /* the arrays may have moved */
        PyErr_NoMemory();
        return 0;
    }
    decision *d = &self->d;
    double *place = self->numbers;
    d->epsilon = place, place += size;
    d->program.a = place, place += both;
    d->program.b = place, place += both;
    d->program.limit = place, place += both;
    d->lp.limits = place, place += both;
    d->lp.rows = (double(*)[MOST_Z])place;
    d->at_once = self->at_once;
    d->program.violated = self->at_once + size;
    d->lp.free = self->at_once + size + both;
    self->size = size;
    return 1;
}

enum { PASSED, CORRECTED, OPEN, BELOW };
static const char *const STATUS_NAMES[] = {"not run", "not needed", "solved"};

/* (kind, action, slack, active rows, least h now, least h next, solver) */
static PyObject *answer(Search *self, int kind, const candidate *c, solver_status status, double binding)
{
    decision *d = &self->d;
    const int rows = d->rows;
    double slack = 0.0;
    PyObject *active = PyTuple_New(0);
    int count = 0, *order = NULL;
    for (int row = 0; row < rows; row++) {
        if (c->violated[row] && -c->residual[row] > slack)
            slack = -c->residual[row];
        if (c->residual[row] <= binding * d->scales[row]) {
            if (!order)
                order = PyMem_Malloc(sizeof(int) * (size_t)rows);
            if (!order) {
                Py_XDECREF(active);
                return PyErr_NoMemory();
            }
            /* the tightest first, of equal ones the earlier */
            const double value = c->residual[row] / d->scales[row];
            int place = count++;
            for (; place > 0 && value < c->residual[order[place - 1]] / d->scales[order[place - 1]]; place--)
                order[place] = order[place - 1];
            order[place] = row;
        }
    }
    if (count) {
        Py_XDECREF(active);
        active = PyTuple_New(count);
        for (int i = 0; active && i < count; i++)
            PyTuple_SET_ITEM(active, i, PyLong_FromLong(order[i]));
    }
    PyMem_Free(order);
    return Py_BuildValue("(iNdNdds)", kind, tuple_of(c->action, self->set.actions), slack, active, d->min_h_now,
                         c->min_h, STATUS_NAMES[status]);
}

/* The scene of the decisions that follow. */
static int set_scene(Search *self, PyObject *rows, PyObject *epsilon, PyObject *at_once, int cases)
{
    decision *d = &self->d;
    const barrier_rows *own = barriers_of(rows);
    if (!own || own->rows < 1) {
        PyErr_Format(PyExc_TypeError, "rows: got another object than compiled rows");
        return 0;
    }
    const int each = own->rows, count = each * cases;
    if (cases < 1 || cases > MOST_STATES / own->states || (cases > 1 && own->rollout)) {
        PyErr_Format(PyExc_ValueError, "got %d states, wanted fewer", cases);
        return 0;
    }
    Py_CLEAR(self->rows);
    Py_CLEAR(self->names); /* those of another scene */
    if (!reserve(self, count) || !doubles(epsilon, count, (double *)d->epsilon, "epsilon"))
        return 0;
    PyObject *once = PySequence_Fast(at_once, "at_once");
    if (!once || PySequence_Fast_GET_SIZE(once) != each) {
        Py_XDECREF(once);
        if (!PyErr_Occurred())
            PyErr_Format(PyExc_ValueError, "at_once of other rows");
        return 0;
    }
    for (int row = 0; row < count; row++)
        self->at_once[row] = PySequence_Fast_GET_ITEM(once, row % each) == Py_True;
    Py_DECREF(once);
    d->cases = cases, d->rows = count, d->states = own->states * cases;
    Py_INCREF(rows);
    self->rows = rows;
    d->set = &self->set, d->barriers = own, d->state = self->state, d->latent = self->latent;
    return 1;
}

/* Chooses the model: f and g at this state, networks that compute them (`ask_networks`), or the compiled step. */
static int set_model(Search *self, PyObject *known, double period, double trained_period)
{
    decision *d = &self->d;
    const int states = d->barriers->states;
    d->known = NULL, d->model = NULL, self->networks = NULL;
    if (PyObject_TypeCheck(known, &NetworksType) && d->cases == 1) {
        Networks *networks = (Networks *)known;
        if (!networks->owner || networks->states != states || networks->actions != self->set.actions) {
            PyErr_SetString(PyExc_ValueError, "networks of another robot");
            return 0;
        }
        d->known = self->known, d->period = period, d->trained_period = trained_period;
        self->networks = networks;
        return 1;
    }
    if (known != Py_None && d->cases == 1) {
        d->known = self->known, d->period = period, d->trained_period = trained_period;
        return doubles(known, states * (self->set.actions + 1), self->known, "known") != NULL;
    }
    if (!self->model || self->model->own.states != states) {
        PyErr_Format(PyExc_ValueError, "a step of other states");
        return 0;
    }
    d->model = &self->model->own;
    return 1;
}

/* So many latents does the model take. */
static int latents_of(const Search *self)
{
    return self->d.model ? self->d.model->latents : self->networks ? self->networks->latents : 0;
}

/* f and g at the state of the decision; 0: declined. */
static int ask_networks(Search *self)
{
    if (!self->networks)
        return 1;
    const double *known = known_of(self->networks, self->state, self->latent);
    /* a copy: other filters may ask the same networks before this decision is searched any further */
    if (known)
        memcpy(self->known, known, sizeof(double) * (size_t)(self->d.barriers->states * (self->set.actions + 1)));
    return known != NULL;
}

/* The nominal action or the nearest feasible one, in `found`; -1: declined. `least` is the smallest h at the measured
   state, where that is another one than the state of the decision; else NaN. */
static int decide_quickly(Search *self, double least)
{
    decision *d = &self->d;
    double clipped[MOST_ACTIONS];
    d->has_last_g = d->saturated = 0;
    d->why = NULL;
    forget(d);
    if (setjmp(d->declined))
        return -1;
    set_right_hand_side(d);
    d->min_h_now = isnan(least) ? d->min_h_now : least;
    clip_action(&self->set, d->nominal, clipped);
    d->nominal_candidate = d->found = evaluate(d, clipped);
    self->status = NOT_NEEDED;
    if (d->min_h_now < 0.0)
        return BELOW;
    if (d->found->feasible)
        return PASSED;
    d->found = solve_sqp(d, d->nominal, d->nominal_candidate, self->set.rounds, &self->status);
    if (!d->found->feasible)
        return OPEN;
    d->found = finish_feasible(d, d->found);
    return CORRECTED;
}

static PyObject *search_decide(Search *self, PyObject *const *args, Py_ssize_t count)
{
    decision *d = &self->d;
    const barrier_rows *own = count == 11 ? barriers_of(args[0]) : NULL;
    const Py_ssize_t numbers = own ? PySequence_Size(args[1]) : 0;
    if (!check_count(count, 11) || numbers < 0)
        return NULL;
    const int cases = own && own->states && numbers <= MOST_STATES ? (int)numbers / own->states : 1;
    if (!set_scene(self, args[0], args[5], args[6], cases))
        return NULL;
    const double least = PyFloat_AsDouble(args[10]);
    const double period = PyFloat_AsDouble(args[8]), trained_period = PyFloat_AsDouble(args[9]);
    d->time = PyFloat_AsDouble(args[4]);
    if (PyErr_Occurred() || !set_model(self, args[7], period, trained_period) ||
        !doubles(args[1], d->states, self->state, "state") ||
        !doubles(args[2], self->set.actions, d->nominal, "nominal") ||
        (latents_of(self) && !doubles(args[3], latents_of(self), self->latent, "latent")))
        return NULL;
    if (!ask_networks(self))
        Py_RETURN_NONE;
    const int kind = decide_quickly(self, least);
    if (kind < 0)
        Py_RETURN_NONE;
    return answer(self, kind, d->found, self->status, kind == PASSED || kind == CORRECTED ? DOUBTFUL : 0.0);
}

/* ---- a whole verdict, for inputs of the usual kinds ---- */

enum { STATE, NOMINAL, LATENT, RANGES };
enum { ACTION_, STATUS_, REASON_, SLACK_, ACTIVE_, H_NOW_, H_NEXT_, MARGIN_, SOLVER_, MICROSECONDS_, NOMINAL_, KNOWN_,
       FIELDS };
static const char *const FIELD_NAMES[FIELDS] = {"action", "status", "reason", "slack", "active", "h_now", "h_next",
                                                "margin", "solver", "microseconds", "nominal", "known"};
static PyObject *field_keys[FIELDS], *solver_names[3], *dict_name;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Copies an array, list or tuple of floats within its range; 0: it is of another kind, and Python has to look. */
static int usual(const Search *self, int which, PyObject *value, int count, double *out)
{
    if (Py_TYPE(value) == (PyTypeObject *)self->array_type) {
        Py_buffer view;
        if (PyObject_GetBuffer(value, &view, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS) < 0) {
            PyErr_Clear();
            return 0;
        }
        const int good = view.ndim == 1 && view.shape[0] == count && view.format && !strcmp(view.format, "d");
        if (good)
            memcpy(out, view.buf, sizeof(double) * (size_t)count);
        PyBuffer_Release(&view);
        if (!good)
            return 0;
    } else if (PyTuple_CheckExact(value) || PyList_CheckExact(value)) {
        if (PySequence_Fast_GET_SIZE(value) != count)
            return 0;
        for (int i = 0; i < count; i++) {
            PyObject *item = PySequence_Fast_GET_ITEM(value, i);
            if (!PyFloat_CheckExact(item))
                return 0;
            out[i] = PyFloat_AS_DOUBLE(item);
        }
    } else
        return 0;
    const double *low = self->low[which], *high = self->high[which];
    for (int i = 0; i < count; i++)
        if (out[i] - out[i] != 0.0 || (low && (out[i] < low[i] || out[i] > high[i])))
            return 0;
    return 1;
}

static PyObject *array_of(const Search *self, const double *values, Py_ssize_t count, int writable)
{
    const char *bytes = (const char *)values;
    const Py_ssize_t size = count * (Py_ssize_t)sizeof(double);
    PyObject *data = writable ? PyByteArray_FromStringAndSize(bytes, size) : PyBytes_FromStringAndSize(bytes, size);
    PyObject *found = data ? PyObject_CallOneArg(self->from_buffer, data) : NULL;
    Py_XDECREF(data);
    return found;
}

/* Names of the rows that bind, the tightest first, each once. */
static PyObject *active_names(const Search *self, PyObject *rows)
{
    const Py_ssize_t count = PyTuple_GET_SIZE(rows);
    PyObject *names = PyList_New(0);
    for (Py_ssize_t i = 0; names && i < count; i++) {
        const long row = PyLong_AsLong(PyTuple_GET_ITEM(rows, i));
        PyObject *name = PyTuple_GET_ITEM(self->names, row);
        const int known = PySequence_Contains(names, name);
        if (known < 0 || (!known && PyList_Append(names, name) < 0))
            Py_CLEAR(names);
    }
    PyObject *found = names ? PyList_AsTuple(names) : NULL;
    Py_XDECREF(names);
    return found;
}

/* (verdict class, statuses passed and corrected, reason outside the limits, array type, frombuffer, three ranges): a
   range is None or (low, high). */
static PyObject *search_prepare(Search *self, PyObject *const *args, Py_ssize_t count)
{
    if (!check_count(count, 9))
        return NULL;
    PyObject **const places[] = {&self->verdict_type, &self->passed, &self->corrected, &self->outside,
                                 &self->array_type, &self->from_buffer};
    if (!PyType_Check(args[0]) || !PyType_Check(args[4]))
        return PyErr_Format(PyExc_TypeError, "wanted classes");
    for (int i = 0; i < 6; i++) {
        Py_INCREF(args[i]);
        Py_XSETREF(*places[i], args[i]);
    }
    for (int i = 0; i < RANGES; i++) {
        PyObject *range = args[6 + i];
        double values[2][256];
        PyMem_Free(self->low[i]);
        self->low[i] = self->high[i] = NULL;
        if (range == Py_None)
            continue;
        if (!PyTuple_Check(range) || PyTuple_GET_SIZE(range) != 2)
            return PyErr_Format(PyExc_TypeError, "range: wanted low and high");
        const Py_ssize_t size = PySequence_Size(PyTuple_GET_ITEM(range, 0));
        if (size < 0 || size > 256 || !doubles(PyTuple_GET_ITEM(range, 0), size, values[0], "low") ||
            !doubles(PyTuple_GET_ITEM(range, 1), size, values[1], "high"))
            return PyErr_Occurred() ? NULL : PyErr_Format(PyExc_ValueError, "range: too many numbers");
        self->low[i] = PyMem_Malloc(sizeof(double) * (size_t)(2 * size + 1));
        if (!self->low[i])
            return PyErr_NoMemory();
        self->high[i] = self->low[i] + size;
        memcpy(self->low[i], values[0], sizeof(double) * (size_t)size);
        memcpy(self->high[i], values[1], sizeof(double) * (size_t)size);
        self->range_size[i] = (int)size;
    }
    Py_RETURN_NONE;
}

/* (rows, epsilon, at_once, names, margin, remark) of the verdicts that follow. */
static PyObject *search_scene(Search *self, PyObject *const *args, Py_ssize_t count)
{
    if (!check_count(count, 6) || !set_scene(self, args[0], args[1], args[2], 1))
        return NULL;
    if (!PyTuple_Check(args[3]) || PyTuple_GET_SIZE(args[3]) != self->d.rows)
        return PyErr_Format(PyExc_ValueError, "names of other rows");
    Py_INCREF(args[3]);
    Py_XSETREF(self->names, args[3]);
    Py_INCREF(args[4]);
    Py_XSETREF(self->margin, args[4]);
    Py_INCREF(args[5]);
    Py_XSETREF(self->remark, args[5]);
    Py_RETURN_NONE;
}

/* verdict(state, nominal, latent, time, known, period, trained_period): of a nominal action that is feasible, or
   corrected; None: Python has to decide. */
static PyObject *search_verdict(Search *self, PyObject *const *args, Py_ssize_t count)
{
    const double start = now();
    decision *d = &self->d;
    if (!check_count(count, 7) || !self->rows || !self->names || !self->verdict_type)
        return PyErr_Occurred() ? NULL : PyErr_Format(PyExc_ValueError, "no scene");
    const int states = d->barriers->states, actions = self->set.actions;
    d->time = PyFloat_AsDouble(args[3]);
    const double period = PyFloat_AsDouble(args[5]), trained_period = PyFloat_AsDouble(args[6]);
    if (PyErr_Occurred() || !set_model(self, args[4], period, trained_period))
        return NULL;
    for (int i = 0; i < RANGES; i++) {
        const int wanted = i == STATE ? states : i == NOMINAL ? actions : latents_of(self);
        if (self->low[i] && (i != LATENT || d->model || self->networks) && self->range_size[i] != wanted)
            Py_RETURN_NONE;
    }
    if (!usual(self, STATE, args[0], states, self->state) || !usual(self, NOMINAL, args[1], actions, d->nominal) ||
        ((d->model || self->networks) && !usual(self, LATENT, args[2], latents_of(self), self->latent)) ||
        !ask_networks(self))
        Py_RETURN_NONE;
    const int kind = decide_quickly(self, NAN);
    if (kind != PASSED && kind != CORRECTED)
        Py_RETURN_NONE;
    int unchanged = kind == PASSED;
    for (int i = 0; i < actions; i++)
        unchanged = unchanged && d->found->action[i] == d->nominal[i];
    PyObject *found = answer(self, kind, d->found, self->status, DOUBTFUL);
    if (!found)
        return NULL;
    PyObject *active = PyTuple_GET_ITEM(found, 3), *values[FIELDS];
    /* equal numbers may differ in the sign of zero: the nominal action is passed on bit for bit */
    values[ACTION_] = array_of(self, unchanged ? d->nominal : d->found->action, actions, 0);
    values[STATUS_] = Py_NewRef(unchanged ? self->passed : self->corrected);
    if (kind == PASSED && !unchanged && PyUnicode_GetLength(self->remark))
        values[REASON_] = PyUnicode_FromFormat("%U %U", self->outside, self->remark);
    else
        values[REASON_] = Py_NewRef(kind == PASSED && !unchanged ? self->outside : self->remark);
    values[SLACK_] = Py_NewRef(PyTuple_GET_ITEM(found, 2));
    values[ACTIVE_] = PyTuple_GET_SIZE(active) ? active_names(self, active) : Py_NewRef(active);
    values[H_NOW_] = Py_NewRef(PyTuple_GET_ITEM(found, 4));
    values[H_NEXT_] = Py_NewRef(PyTuple_GET_ITEM(found, 5));
    values[MARGIN_] = Py_NewRef(self->margin);
    values[SOLVER_] = Py_NewRef(solver_names[self->status]);
    values[NOMINAL_] = array_of(self, d->nominal, actions, 1);
    values[KNOWN_] = Py_NewRef(Py_True);
    values[MICROSECONDS_] = PyFloat_FromDouble(1e6 * (now() - start));
    Py_DECREF(found);
    PyObject *fields = PyDict_New();
    int good = fields != NULL;
    for (int i = 0; i < FIELDS; i++) {
        good = good && values[i] && PyDict_SetItem(fields, field_keys[i], values[i]) == 0;
        Py_XDECREF(values[i]);
    }
    PyTypeObject *type = (PyTypeObject *)self->verdict_type;
    PyObject *verdict = good ? type->tp_alloc(type, 0) : NULL;
    /* not PyObject_GenericSetDict: since Python 3.13 attributes are then still looked up in the object itself */
    if (verdict && PyObject_GenericSetAttr(verdict, dict_name, fields) < 0)
        Py_CLEAR(verdict);
    Py_XDECREF(fields);
    return verdict;
}

/* (action, next state, h, residual, violated rows) */
static PyObject *plain_candidate(Search *self, const candidate *c)
{
    const decision *d = &self->d;
    PyObject *violated = PyList_New(0);
    for (int row = 0; violated && row < d->rows; row++)
        if (c->violated[row]) {
            PyObject *index = PyLong_FromLong(row);
            if (!index || PyList_Append(violated, index) < 0)
                Py_CLEAR(violated);
            Py_XDECREF(index);
        }
    return Py_BuildValue("(NNNNN)", tuple_of(c->action, self->set.actions), list_of(c->next, d->states),
                         list_of(c->h, d->rows), list_of(c->residual, d->rows), violated);
}

/* (answer as of `decide`, violated rows, candidate) of an action. */
static PyObject *described(Search *self, int kind, const candidate *c, solver_status status)
{
    PyObject *violated = answer(self, kind, c, status, 0.0);
    PyObject *rows = violated ? Py_NewRef(PyTuple_GET_ITEM(violated, 3)) : NULL;
    Py_XDECREF(violated);
    return Py_BuildValue("(NNN)", answer(self, kind, c, status, DOUBTFUL), rows, plain_candidate(self, c));
}

static PyObject *search_evaluate(Search *self, PyObject *const *args, Py_ssize_t count)
{
    double action[MOST_ACTIONS];
    if (!check_count(count, 1) || !self->rows || !doubles(args[0], self->set.actions, action, "action"))
        return NULL;
    if (setjmp(self->d.declined))
        Py_RETURN_NONE;
    return described(self, OPEN, evaluate(&self->d, action), self->status);
}

enum { FROM_OTHER_START, FROM_SAMPLE, FROM_LEAST_VIOLATION, LEAST_VIOLATION };

/* (answer as of `decide`, how) of a feasible action. */
static PyObject *feasible_answer(Search *self, candidate *found, solver_status status, int how)
{
    candidate *nearest = finish_feasible(&self->d, found);
    return Py_BuildValue("(Ni)", answer(self, CORRECTED, nearest, status, DOUBTFUL), how);
}

/* After `decide` has found no feasible action: (answer as of `decide`, how), for a least-violation action also the
   rows that it violates, those that no action influences, and the candidate; or None. */
static PyObject *search_search(Search *self, PyObject *const *args, Py_ssize_t count)
{
    decision *d = &self->d;
    double action[MOST_ACTIONS];
    candidate *grid[MOST_CORNERS], *known[MOST_CORNERS + 8];
    solver_status status = SOLVED;
    int uncontrollable_count = 0, *uncontrollable = NULL;
    if (!check_count(count, 1) || !self->rows || !doubles(args[0], self->set.actions, action, "backup"))
        return NULL;
    if (setjmp(d->declined))
        Py_RETURN_NONE;
    candidate *backup = evaluate(d, action), *other, *best;
    const int points = evaluate_grid(d, grid);
    known[0] = backup;
    if (d->min_h_now < 0.0) {
        known[1] = d->nominal_candidate;
        memcpy(known + 2, grid, sizeof(candidate *) * (size_t)points);
        best = least_violation(d, known, points + 2, &uncontrollable, &uncontrollable_count);
    } else {
        memcpy(known + 1, grid, sizeof(candidate *) * (size_t)points);
        other = restart_from(d, known, points + 1, &status);
        if (other->feasible)
            return feasible_answer(self, other, status, FROM_OTHER_START);
        known[1] = d->found, known[2] = other;
        memcpy(known + 3, grid, sizeof(candidate *) * (size_t)points);
        candidate *nearby = coordinate_search(d, known, points + 3);
        if (nearby->feasible) {
            other = restart_from(d, &nearby, 1, &status);
            return feasible_answer(self, other, status, FROM_SAMPLE);
        }
        known[1] = d->nominal_candidate, known[2] = d->found, known[3] = other, known[4] = nearby;
        memcpy(known + 5, grid, sizeof(candidate *) * (size_t)points);
        best = least_violation(d, known, points + 5, &uncontrollable, &uncontrollable_count);
        if (best->feasible) {
            other = restart_from(d, &best, 1, &status);
            return feasible_answer(self, other, status, FROM_LEAST_VIOLATION);
        }
    }
    PyObject *rows = PyTuple_New(uncontrollable_count);
    for (int i = 0; rows && i < uncontrollable_count; i++)
        PyTuple_SET_ITEM(rows, i, PyLong_FromLong(uncontrollable[i]));
    PyObject *found = described(self, OPEN, best, status);
    if (!found) {
        Py_XDECREF(rows);
        return NULL;
    }
    PyObject *whole = Py_BuildValue("(OiONO)", PyTuple_GET_ITEM(found, 0), LEAST_VIOLATION, PyTuple_GET_ITEM(found, 1),
                                    rows, PyTuple_GET_ITEM(found, 2));
    Py_DECREF(found);
    return whole;
}

/* h (rows,) at the state of the decision. */
static PyObject *search_h_now(Search *self, PyObject *unused)
{
    (void)unused;
    return self->rows ? list_of(self->d.h_now, self->d.rows) : PyErr_Format(PyExc_ValueError, "no decision");
}

static PyObject *search_why(Search *self, PyObject *unused)
{
    (void)unused;
    return PyUnicode_FromString(self->d.why ? self->d.why : "");
}

static PyMethodDef search_methods[] = {
    {"decide", (PyCFunction)(void (*)(void))search_decide, METH_FASTCALL, "See safety/compiled_decision.py."},
    {"prepare", (PyCFunction)(void (*)(void))search_prepare, METH_FASTCALL, "See safety/compiled_decision.py."},
    {"scene", (PyCFunction)(void (*)(void))search_scene, METH_FASTCALL, "See safety/compiled_decision.py."},
    {"verdict", (PyCFunction)(void (*)(void))search_verdict, METH_FASTCALL, "See safety/compiled_decision.py."},
    {"search", (PyCFunction)(void (*)(void))search_search, METH_FASTCALL, "See safety/compiled_decision.py."},
    {"evaluate", (PyCFunction)(void (*)(void))search_evaluate, METH_FASTCALL, "A candidate, or None."},
    {"why", (PyCFunction)search_why, METH_NOARGS, "Why the last decision was declined; empty: it was not."},
    {"h_now", (PyCFunction)search_h_now, METH_NOARGS, "h (rows,) at the state of the decision."},
    {NULL, NULL, 0, NULL}};

static PyTypeObject SearchType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "safedpa_kernel.Search", .tp_basicsize = sizeof(Search),
    .tp_flags = Py_TPFLAGS_DEFAULT, .tp_new = PyType_GenericNew, .tp_init = (initproc)search_init,
    .tp_dealloc = (destructor)search_free, .tp_methods = search_methods,
    .tp_doc = "One decision at a time of one filter."};

static PyMethodDef functions[] = {
    {"discs_near", selection_discs_near, METH_VARARGS, "See safety/barriers/disc_selection.py."},
    {"fastest", selection_fastest, METH_VARARGS, "See safety/barriers/disc_selection.py."},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "safedpa_kernel", NULL, -1, functions, NULL, NULL, NULL, NULL};

__attribute__((visibility("default"))) PyObject *PyInit_safedpa_kernel(void)
{
    PyObject *module = PyModule_Create(&definition);
    if (!module || PyType_Ready(&StepType) < 0 || PyType_Ready(&RowsType) < 0 || PyType_Ready(&SearchType) < 0 ||
        PyType_Ready(&RolloutType) < 0 || PyType_Ready(&NetworksType) < 0)
        return NULL;
    if (!(dict_name = PyUnicode_InternFromString("__dict__")))
        return NULL;
    for (int i = 0; i < FIELDS; i++)
        if (!(field_keys[i] = PyUnicode_InternFromString(FIELD_NAMES[i])))
            return NULL;
    for (int i = 0; i < 3; i++)
        if (!(solver_names[i] = PyUnicode_InternFromString(STATUS_NAMES[i])))
            return NULL;
    Py_INCREF(&StepType), Py_INCREF(&RowsType), Py_INCREF(&SearchType), Py_INCREF(&RolloutType);
    Py_INCREF(&NetworksType);
    if (PyModule_AddObject(module, "Step", (PyObject *)&StepType) < 0 ||
        PyModule_AddObject(module, "Rows", (PyObject *)&RowsType) < 0 ||
        PyModule_AddObject(module, "Rollout", (PyObject *)&RolloutType) < 0 ||
        PyModule_AddObject(module, "Networks", (PyObject *)&NetworksType) < 0 ||
        PyModule_AddObject(module, "Search", (PyObject *)&SearchType) < 0)
        return NULL;
    return module;
}
