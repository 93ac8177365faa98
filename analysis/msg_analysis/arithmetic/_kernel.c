// SPDX-FileCopyrightText: 2026 msg_agents contributors
// SPDX-License-Identifier: Apache-2.0

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
             " links=b'', first=b'', senders=b'', ahead=b'', delay=0, lost=b'', broadcast=b'', link=b'', held=b'')\n\n"
             "Fill states[delay + 1:] from the states before, with the reception of the last nine: see many_steps.py.");

/* What happens on the air: arrays of Reception in many_steps.py; what there is not is NULL. */
struct air {
    const int64_t *links, *first, *senders, *ahead;
    const char *lost;
    const double *broadcast, *link;
    double *held;
    int64_t own;                /* number in place of a link for an agent's own value */
    Py_ssize_t messages, delay; /* messages of a link */
};

/* What a link brings in the step k: the value of the sender, with its noise; ``room`` is for the sum. */
static const double *message(const struct air *air, const double *states, int64_t link, Py_ssize_t k,
                             Py_ssize_t agents, Py_ssize_t replicas, double *room)
{
    const int64_t sender = air->senders[link];
    const Py_ssize_t which = k + air->ahead[link];
    const double *values = states + (which * agents + sender) * replicas;
    if (air->broadcast) {
        for (Py_ssize_t r = 0; r < replicas; ++r)
            room[r] = values[r] + air->broadcast[(sender * air->messages + which) * replicas + r];
        values = room;
    }
    if (air->link) {
        for (Py_ssize_t r = 0; r < replicas; ++r)
            room[r] = values[r] + air->link[(link * air->messages + which) * replicas + r];
        values = room;
    }
    return values;
}

static int is_lost(const struct air *air, int64_t link, Py_ssize_t k)
{
    return air->lost[link * air->messages + k + air->ahead[link]];
}

/* Keep what is heard on all links to an agent in the step k, whether this step uses it or not. */
static void hold(const struct air *air, const double *states, int64_t receiver, Py_ssize_t k, Py_ssize_t agents,
                 Py_ssize_t replicas, double *room)
{
    for (int64_t link = air->first[receiver]; link < air->first[receiver + 1]; ++link)
        if (!is_lost(air, link, k))
            memcpy(air->held + link * replicas, message(air, states, link, k, agents, replicas, room),
                   replicas * sizeof *room);
}

/* The values that an agent uses for one term of its sum: of the sender, or its own. */
static const double *heard(const struct air *air, const double *states, int64_t receiver, int64_t sender, Py_ssize_t k,
                           Py_ssize_t agents, Py_ssize_t replicas, double *room)
{
    const int64_t link = air->links[receiver * agents + sender];
    if (link == air->own || (!air->held && is_lost(air, link, k)))
        return states + ((air->delay + k) * agents + receiver) * replicas;
    return air->held ? air->held + link * replicas : message(air, states, link, k, agents, replicas, room);
}

/* Whether all indices in the arrays of a reception are within the others; sets ``own`` and ``messages``. */
static int fits(struct air *air, const Py_buffer *lost, Py_ssize_t links, Py_ssize_t agents, Py_ssize_t steps)
{
    Py_ssize_t latest = 0;
    air->own = links;
    air->messages = lost->len / (links + 1);
    int right = lost->len == air->messages * (links + 1) && air->first[0] == 0 && air->first[agents] == links;
    for (Py_ssize_t i = 0; right && i < agents; ++i)
        right = air->first[i] <= air->first[i + 1];
    for (Py_ssize_t i = 0; right && i < agents * agents; ++i)
        right = air->links[i] >= 0 && air->links[i] <= links;
    for (Py_ssize_t i = 0; right && i < links; ++i) {
        right = air->senders[i] >= 0 && air->senders[i] < agents && (air->ahead[i] == 0 || air->ahead[i] == 1);
        latest = right && air->ahead[i] > latest ? air->ahead[i] : latest;
    }
    return right && air->messages >= steps + latest;
}

static PyObject *advance(PyObject *Py_UNUSED(module), PyObject *arguments)
{
    enum { ORDER, OFFSETS, COLUMNS, WEIGHTS, MODES, DRIVES, STATES, LINKS, FIRST, SENDERS, AHEAD, BROADCAST, LINK, HELD,
           ARRAYS };
    Py_buffer views[ARRAYS] = {{0}}, lost = {0};
    Py_ssize_t agents, replicas, delay = 0;
    if (!PyArg_ParseTuple(arguments, "y*y*y*y*y*y*w*nn|y*y*y*y*ny*y*y*w*", &views[ORDER], &views[OFFSETS],
                          &views[COLUMNS], &views[WEIGHTS], &views[MODES], &views[DRIVES], &views[STATES], &agents,
                          &replicas, &views[LINKS], &views[FIRST], &views[SENDERS], &views[AHEAD], &delay, &lost,
                          &views[BROADCAST], &views[LINK], &views[HELD]))
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
    right = right && agents > 0 && agents <= counts[STATES] && replicas > 0 && replicas <= counts[STATES] / agents &&
            delay >= 0 && delay < counts[STATES];
    const Py_ssize_t steps = counts[MODES], terms = counts[COLUMNS], size = right ? agents * replicas : 1;
    const Py_ssize_t graphs = right ? counts[ORDER] / agents : 0;
    right = right && counts[ORDER] == graphs * agents && counts[OFFSETS] == graphs * agents + 1 &&
            counts[WEIGHTS] == terms && counts[DRIVES] == steps * size && counts[STATES] == (delay + steps + 1) * size;
    for (Py_ssize_t i = 0; right && i < graphs * agents; ++i)
        right = order[i] >= 0 && order[i] < agents && offsets[i] >= 0 && offsets[i] < offsets[i + 1] &&
                offsets[i + 1] <= terms;
    for (Py_ssize_t i = 0; right && i < terms; ++i)
        right = columns[i] >= 0 && columns[i] < 2 * agents;
    for (Py_ssize_t k = 0; right && k < steps; ++k)
        right = modes[k] >= 0 && modes[k] < graphs;
    struct air air = {views[LINKS].buf, views[FIRST].buf, views[SENDERS].buf, views[AHEAD].buf, lost.buf,
                      NULL, NULL, NULL, 0, 0, delay};
    double *room = NULL;
    if (right && views[LINKS].len) {
        const Py_ssize_t links = counts[SENDERS];
        right = counts[LINKS] / agents == agents && counts[LINKS] % agents == 0 && counts[FIRST] == agents + 1 &&
                counts[AHEAD] == links && fits(&air, &lost, links, agents, steps);
        if (right && views[BROADCAST].len) {
            air.broadcast = views[BROADCAST].buf;
            right = counts[BROADCAST] == agents * air.messages * replicas;
        }
        if (right && views[LINK].len) {
            air.link = views[LINK].buf;
            right = counts[LINK] == links * air.messages * replicas;
        }
        if (right && views[HELD].len) {
            air.held = views[HELD].buf;
            right = counts[HELD] == links * replicas;
        }
        if (right && (room = PyMem_Malloc(replicas * sizeof *room)) == NULL) {
            for (int i = 0; i < ARRAYS; ++i)
                PyBuffer_Release(&views[i]);
            PyBuffer_Release(&lost);
            return PyErr_NoMemory();
        }
    } else
        right = right && delay == 0;
    if (right) {
        Py_BEGIN_ALLOW_THREADS;
        for (Py_ssize_t k = 0; k < steps; ++k) {
            /* x(k), and after it x(k+1) */
            const double *before = states + (delay + k) * size, *drive = drives + k * size;
            for (Py_ssize_t row = modes[k] * agents; row < (modes[k] + 1) * agents; ++row) {
                double *total = states + (delay + k + 1) * size + order[row] * replicas;
                if (air.held)
                    hold(&air, states, order[row], k, agents, replicas, room);
                for (int64_t term = offsets[row]; term < offsets[row + 1]; ++term) {
                    const double weight = weights[term];
                    const double *values = room ? heard(&air, states, order[row], columns[term] % agents, k, agents,
                                                        replicas, room)
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
    PyBuffer_Release(&lost);
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
