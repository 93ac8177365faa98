// Copyright 2026 msg_agents maintainers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

/* The update law, compiled: on states as they travel, and for many steps of a whole network.
 *
 * What model/arithmetic/payload.py and many_steps.py do with numpy, without numpy's half a microsecond per operation: in
 * a network that keeps every core busy, nothing is ever in the cache, and an agent's step costs several times what it
 * costs alone. The results are equal to the last bit: the same multiplications and additions in the same order, and the
 * compiler is told not to fuse them.
 */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
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

PyDoc_STRVAR(advance_doc,
             "advance(order, offsets, columns, weights, modes, drives, states, agents, replicas,"
             " links=b'', own=b'', broadcast=b'', link=b'')\n\n"
             "Fill states[1:] from states[0], with the reception of the last four: see many_steps.py.");

/* What happens on the air: arrays of Reception in many_steps.py; noise that there is none of is NULL. */
struct air {
    const int64_t *links;
    const char *own;
    const double *broadcast, *link;
    Py_ssize_t steps;
};

/* The values that an agent uses for one term of its sum: of the sender, or its own; ``room`` is for them. */
static const double *heard(const struct air *air, const double *before, int64_t receiver, int64_t sender,
                           Py_ssize_t k, Py_ssize_t agents, Py_ssize_t replicas, double *room)
{
    const Py_ssize_t at = air->links[receiver * agents + sender] * air->steps + k;
    if (air->own[at])
        return before + receiver * replicas;
    const double *values = before + sender * replicas;
    if (air->broadcast) {
        for (Py_ssize_t r = 0; r < replicas; ++r)
            room[r] = values[r] + air->broadcast[(sender * air->steps + k) * replicas + r];
        values = room;
    }
    if (air->link) {
        for (Py_ssize_t r = 0; r < replicas; ++r)
            room[r] = values[r] + air->link[at * replicas + r];
        values = room;
    }
    return values;
}

static PyObject *advance(PyObject *Py_UNUSED(module), PyObject *arguments)
{
    enum { ORDER, OFFSETS, COLUMNS, WEIGHTS, MODES, DRIVES, STATES, LINKS, BROADCAST, LINK, ARRAYS };
    Py_buffer views[ARRAYS] = {{0}}, own = {0};
    Py_ssize_t agents, replicas;
    if (!PyArg_ParseTuple(arguments, "y*y*y*y*y*y*w*nn|y*y*y*y*", &views[ORDER], &views[OFFSETS], &views[COLUMNS],
                          &views[WEIGHTS], &views[MODES], &views[DRIVES], &views[STATES], &agents, &replicas,
                          &views[LINKS], &own, &views[BROADCAST], &views[LINK]))
        return NULL;
    const int64_t *order = views[ORDER].buf, *offsets = views[OFFSETS].buf, *columns = views[COLUMNS].buf;
    const int64_t *modes = views[MODES].buf;
    const double *weights = views[WEIGHTS].buf, *drives = views[DRIVES].buf;
    double *states = views[STATES].buf;
    Py_ssize_t counts[ARRAYS];
    int right = 1;
    for (int i = 0; i < ARRAYS; ++i) {
        counts[i] = views[i].len / 8;
        right = right && views[i].len % 8 == 0;
    }
    right = right && agents > 0 && agents <= counts[STATES] && replicas > 0 && replicas <= counts[STATES] / agents;
    const Py_ssize_t steps = counts[MODES], terms = counts[COLUMNS], size = right ? agents * replicas : 1;
    const Py_ssize_t graphs = right ? counts[ORDER] / agents : 0;
    right = right && counts[ORDER] == graphs * agents && counts[OFFSETS] == graphs * agents + 1 &&
            counts[WEIGHTS] == terms && counts[DRIVES] == steps * size && counts[STATES] == (steps + 1) * size;
    for (Py_ssize_t i = 0; right && i < graphs * agents; ++i)
        right = order[i] >= 0 && order[i] < agents && offsets[i] >= 0 && offsets[i] < offsets[i + 1] &&
                offsets[i + 1] <= terms;
    for (Py_ssize_t i = 0; right && i < terms; ++i)
        right = columns[i] >= 0 && columns[i] < 2 * agents;
    for (Py_ssize_t k = 0; right && k < steps; ++k)
        right = modes[k] >= 0 && modes[k] < graphs;
    struct air air = {views[LINKS].buf, own.buf, NULL, NULL, 0};
    double *room = NULL;
    if (right && views[LINKS].len) {
        Py_ssize_t numbers = 1;
        right = counts[LINKS] / agents == agents && counts[LINKS] % agents == 0;
        for (Py_ssize_t i = 0; right && i < counts[LINKS]; ++i) {
            right = air.links[i] >= 0 && air.links[i] < own.len;
            numbers = right && air.links[i] >= numbers ? air.links[i] + 1 : numbers;
        }
        air.steps = right ? own.len / numbers : 0;
        right = right && air.steps >= steps && own.len == numbers * air.steps;
        for (Py_ssize_t i = 0; right && i < terms; ++i)
            right = columns[i] < agents; /* no agent hears what another one makes in the same step */
        if (right && views[BROADCAST].len) {
            air.broadcast = views[BROADCAST].buf;
            right = counts[BROADCAST] == agents * air.steps * replicas;
        }
        if (right && views[LINK].len) {
            air.link = views[LINK].buf;
            right = counts[LINK] == own.len * replicas;
        }
        if (right && (room = PyMem_Malloc(replicas * sizeof *room)) == NULL) {
            for (int i = 0; i < ARRAYS; ++i)
                PyBuffer_Release(&views[i]);
            PyBuffer_Release(&own);
            return PyErr_NoMemory();
        }
    }
    if (right) {
        Py_BEGIN_ALLOW_THREADS;
        for (Py_ssize_t k = 0; k < steps; ++k) {
            const double *before = states + k * size, *drive = drives + k * size; /* x(k), and after it x(k+1) */
            for (Py_ssize_t row = modes[k] * agents; row < (modes[k] + 1) * agents; ++row) {
                double *total = states + (k + 1) * size + order[row] * replicas;
                for (int64_t term = offsets[row]; term < offsets[row + 1]; ++term) {
                    const double weight = weights[term];
                    const double *values =
                        room ? heard(&air, before, order[row], columns[term], k, agents, replicas, room)
                             : before + columns[term] * replicas;
                    if (term == offsets[row])
                        for (Py_ssize_t r = 0; r < replicas; ++r)
                            total[r] = values[r] * weight;
                    else
                        for (Py_ssize_t r = 0; r < replicas; ++r)
                            total[r] += values[r] * weight;
                }
                for (Py_ssize_t r = 0; r < replicas; ++r)
                    total[r] += drive[order[row] * replicas + r];
            }
        }
        Py_END_ALLOW_THREADS;
    }
    PyMem_Free(room);
    for (int i = 0; i < ARRAYS; ++i)
        PyBuffer_Release(&views[i]);
    PyBuffer_Release(&own);
    if (!right)
        return wrong("expected arrays of 8-byte numbers whose sizes and indices fit together");
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"advance", advance, METH_VARARGS, advance_doc},
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
