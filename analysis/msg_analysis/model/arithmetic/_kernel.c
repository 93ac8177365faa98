/* The update law on states as they travel: bytes of little-endian doubles in, bytes out.
 *
 * What model/arithmetic/payload.py does with numpy, without numpy's half a microsecond per operation: in a network that keeps
 * every core busy, nothing is ever in the cache, and an agent's step costs several times what it costs alone. The
 * results are equal to the last bit: the same multiplications and additions in the same order, and the compiler is told
 * not to fuse them.
 */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <string.h>

static PyObject *wrong(const char *what)
{
    PyErr_SetString(PyExc_ValueError, what);
    return NULL;
}

static double number(const char *bytes, Py_ssize_t index)
{
    double value;
    memcpy(&value, bytes + index * sizeof value, sizeof value); /* bytes objects promise no alignment */
    return value;
}

PyDoc_STRVAR(combine_doc,
             "combine(weights, payloads, drive) -> bytes\n\n"
             "sum_j weights[j] * payloads[j], term after term, plus drive.");

static PyObject *combine(PyObject *Py_UNUSED(module), PyObject *const *arguments, Py_ssize_t count)
{
    if (count != 3 || !PyTuple_CheckExact(arguments[0]) || !PyList_CheckExact(arguments[1]) ||
        !PyBytes_CheckExact(arguments[2]))
        return wrong("expected a tuple of weights, a list of payloads, and bytes");
    PyObject *weights = arguments[0], *payloads = arguments[1];
    const Py_ssize_t terms = PyTuple_GET_SIZE(weights), size = PyBytes_GET_SIZE(arguments[2]);
    const Py_ssize_t entries = size / (Py_ssize_t)sizeof(double);
    if (terms == 0 || terms != PyList_GET_SIZE(payloads) || size % sizeof(double))
        return wrong("expected as many payloads as weights, at least one, of whole doubles");
    PyObject *result = PyBytes_FromStringAndSize(NULL, size);
    if (!result)
        return NULL;
    char *total = PyBytes_AS_STRING(result);
    for (Py_ssize_t j = 0; j < terms; ++j) {
        PyObject *payload = PyList_GET_ITEM(payloads, j);
        const double weight = PyFloat_AsDouble(PyTuple_GET_ITEM(weights, j));
        if (weight == -1.0 && PyErr_Occurred()) {
            Py_DECREF(result);
            return NULL;
        }
        if (!PyBytes_CheckExact(payload) || PyBytes_GET_SIZE(payload) != size) {
            Py_DECREF(result);
            return wrong("expected payloads of the size of the drive");
        }
        const char *values = PyBytes_AS_STRING(payload);
        for (Py_ssize_t r = 0; r < entries; ++r) {
            double term = number(values, r) * weight;
            if (j)
                term = number(total, r) + term;
            memcpy(total + r * sizeof term, &term, sizeof term);
        }
    }
    const char *drive = PyBytes_AS_STRING(arguments[2]);
    for (Py_ssize_t r = 0; r < entries; ++r) {
        const double sum = number(total, r) + number(drive, r);
        memcpy(total + r * sizeof sum, &sum, sizeof sum);
    }
    return result;
}

PyDoc_STRVAR(all_finite_doc, "all_finite(payload) -> bool\n\nWhether no entry is infinite or undefined.");

static PyObject *all_finite(PyObject *Py_UNUSED(module), PyObject *payload)
{
    if (!PyBytes_CheckExact(payload) || PyBytes_GET_SIZE(payload) % sizeof(double))
        return wrong("expected bytes of whole doubles");
    const char *values = PyBytes_AS_STRING(payload);
    const Py_ssize_t entries = PyBytes_GET_SIZE(payload) / (Py_ssize_t)sizeof(double);
    for (Py_ssize_t r = 0; r < entries; ++r)
        if (!isfinite(number(values, r)))
            Py_RETURN_FALSE;
    Py_RETURN_TRUE;
}

static PyMethodDef methods[] = {
    {"combine", (PyCFunction)(void (*)(void))combine, METH_FASTCALL, combine_doc},
    {"all_finite", all_finite, METH_O, all_finite_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_kernel", "The update law on states as they travel.", 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__kernel(void)
{
#if PY_BIG_ENDIAN
    PyErr_SetString(PyExc_ImportError, "states travel as little-endian doubles, which this machine does not compute with");
    return NULL;
#else
    return PyModuleDef_Init(&definition);
#endif
}
