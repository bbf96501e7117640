/* The minimum of h along a model's path under its backup, as safedpa/safety/barriers/path_minimum.py computes it.

Generated functions precede this file (safedpa/native/rollout.py): step, backup, h, and, with DERIVATIVES, step_slopes
and h_slopes. There is no global state: all memory is the caller's. Expressions keep the order of the Python source, so
that results have the same bits. */

#define GRADIENT_FACTOR 1.5
#define MIN_INTERVAL (1.0 / 16.0)
#define END_STEP 1e-5
#define SHORT_PATH 4
#define BRENT_TOLERANCE 1e-9
#define BRENT_STEPS 60
#define GOLDEN 0.3819660112501051
#define STEP_SHARE 1e-3
/* samples of one chord: four, and intervals above 1/16 are divided; 3 first intervals give at most 8 each */
#define SAMPLES 40

enum { NOT_FINITE = -1 };

static void advance(const setup *u, const double *x, double *next)
{
    double a[ACTIONS + 1];
    backup(u, x, a);
    step(u, x, a, next);
}

/* Returns the number of states from x on, at most ticks + 1; fewer if the last two are the same bits. */
static int follow(const setup *u, const double *x, int ticks, double *path)
{
    memcpy(path, x, STATES * sizeof(double));
    int count = 1;
    while (count <= ticks) {
        double *next = path + count * STATES;
        advance(u, next - STATES, next);
        count++;
        if (memcmp(next, next - STATES, STATES * sizeof(double)) == 0) break;
    }
    for (int i = 0; i < count * STATES; i++)
        if (!isfinite(path[i])) return NOT_FINITE;
    return count;
}

static void chord_point(const double *path, int k, double share, double *x)
{
    const double *start = path + k * STATES;
    if (share == 0.0)
        memcpy(x, start, STATES * sizeof(double));
    else
        for (int j = 0; j < STATES; j++) x[j] = (1.0 - share) * start[j] + share * start[STATES + j];
}

/* One search: h on a chord, the lowest values so far, and where a NaN was seen. */
typedef struct {
    const setup *u;
    const double *path;
    int chord;
    double *values, *shares, *row_values;
    int *points, *has_nan;
} search;

static void h_at(const search *s, double share, double *out)
{
    double x[STATES];
    chord_point(s->path, s->chord, share, x);
    h(s->u, x, out);
    for (int i = 0; i < s->u->rows; i++) s->has_nan[i] |= out[i] != out[i];
}

static double curve(const search *s, int row, double share)
{
    h_at(s, share, s->row_values);
    return s->row_values[row];
}

/* Brent, Algorithms for Minimization without Derivatives, 1973, chapter 5. */
static double brent(const search *s, int row, double low, double best, double high, double lowest, double *where)
{
    double value = lowest, second_value = lowest, third_value = lowest;
    double second = best, third = best, step_ = 0.0, last = 0.0;
    for (int i = 0; i < BRENT_STEPS; i++) {
        const double middle = 0.5 * (low + high);
        if (fabs(best - middle) <= 2.0 * BRENT_TOLERANCE - 0.5 * (high - low)) break;
        double r = (best - second) * (value - third_value);
        double q = (best - third) * (value - second_value);
        double p = (best - third) * q - (best - second) * r;
        q = 2.0 * (q - r);
        if (q > 0.0) p = -p; else q = -q;
        if (q != 0.0 && fabs(p) < fabs(0.5 * q * last) && q * (low - best) < p && p < q * (high - best)) {
            last = step_;
            step_ = p / q;
            const double below = best + step_ - low, above = high - best - step_;
            if ((above < below ? above : below) < 2.0 * BRENT_TOLERANCE)
                step_ = copysign(BRENT_TOLERANCE, middle - best);
        } else {
            last = (best < middle ? high : low) - best;
            step_ = GOLDEN * last;
        }
        const double tried = best + (fabs(step_) >= BRENT_TOLERANCE ? step_ : copysign(BRENT_TOLERANCE, step_));
        const double found = curve(s, row, tried);
        if (found <= value) {
            if (tried >= best) low = best; else high = best;
            third = second; third_value = second_value;
            second = best; second_value = value;
            best = tried; value = found;
            continue;
        }
        if (tried >= best) high = tried; else low = tried;
        if (found <= second_value || second == best) {
            third = second; third_value = second_value;
            second = tried; second_value = found;
        } else if (found <= third_value || third == best || third == second) {
            third = tried; third_value = found;
        }
    }
    *where = best;
    return value;
}

/* Searches one row of samples; the least sample brackets the minimum if it may be below what is known. */
static void search_row(const search *s, int row, const double *shares, const double *rows, int count)
{
    const int m = s->u->rows;
    int at = 0;
    for (int i = 0; i < count; i++) {
        const double value = rows[i * m + row];
        if (value != value) { at = i; break; }
        if (value < rows[at * m + row]) at = i;
    }
    double steepest = 0.0;
    for (int i = at > 0 ? at - 1 : 0; i < at + 1 && i + 1 < count; i++)
        steepest = maximum(steepest, fabs(rows[(i + 1) * m + row] - rows[i * m + row]));
    const double lowest = rows[at * m + row];
    if (!(lowest - GRADIENT_FACTOR * steepest < s->values[row])) return;
    double low, best, high, value = lowest;
    if (at > 0 && at < count - 1) {
        low = shares[at - 1]; best = shares[at]; high = shares[at + 1];
    } else {
        const double end = shares[at], neighbour = shares[at == 0 ? 1 : at - 1];
        best = end + END_STEP * (neighbour - end);
        value = curve(s, row, best);
        if (value >= lowest) return;
        low = neighbour < end ? neighbour : end;
        high = neighbour > end ? neighbour : end;
    }
    double where;
    const double found = brent(s, row, low, best, high, value, &where);
    if (found < s->values[row]) {
        s->values[row] = found;
        s->points[row] = s->chord;
        s->shares[row] = where;
    }
}

/* Evaluates h at the middle of each interval in which a value might be below the minimum; returns the new count. */
static int divide(const search *s, double *shares, double *rows, int count, double *bound_of_row)
{
    const int m = s->u->rows;
    double middles[SAMPLES];
    int places[SAMPLES], found = 0;
    /* by row: the largest |dh/dt|, then the value that must be undercut */
    double *gradient = bound_of_row, *least = bound_of_row + m;
    for (int r = 0; r < m; r++) {
        gradient[r] = 0.0;
        least[r] = s->values[r];
        for (int i = 0; i < count; i++) least[r] = minimum(least[r], rows[i * m + r]);
        for (int i = 0; i + 1 < count; i++)
            gradient[r] = maximum(gradient[r], fabs(rows[(i + 1) * m + r] - rows[i * m + r]) / (shares[i + 1] - shares[i]));
    }
    for (int i = 0; i + 1 < count; i++) {
        const double width = shares[i + 1] - shares[i];
        if (!(width > MIN_INTERVAL) || count + found >= SAMPLES) continue;
        for (int r = 0; r < m; r++) {
            const double one = rows[i * m + r], other = rows[(i + 1) * m + r];
            if (0.5 * (one + other) - 0.5 * GRADIENT_FACTOR * gradient[r] * width < least[r]) {
                middles[found] = 0.5 * (shares[i + 1] + shares[i]);
                places[found++] = i;
                break;
            }
        }
    }
    /* from the back, so that the places of those before stay */
    for (int j = found - 1; j >= 0; j--) {
        const int at = places[j] + 1;
        memmove(shares + at + 1, shares + at, (count - at) * sizeof(double));
        memmove(rows + (at + 1) * m, rows + at * m, (count - at) * m * sizeof(double));
        shares[at] = middles[j];
        h_at(s, middles[j], rows + at * m);
        count++;
    }
    return found ? count : -count;
}

static void search_chord(const search *s, const double *table, double *memory)
{
    const int m = s->u->rows, k = s->chord;
    double shares[SAMPLES] = {0.0, 0.29, 0.62, 1.0};
    double *rows = memory, *bounds = memory + SAMPLES * m;
    memcpy(rows, table + k * m, m * sizeof(double));
    h_at(s, shares[1], rows + m);
    h_at(s, shares[2], rows + 2 * m);
    memcpy(rows + 3 * m, table + (k + 1) * m, m * sizeof(double));
    int count = 4;
    while ((count = divide(s, shares, rows, count, bounds)) > 0) {}
    for (int row = 0; row < m; row++) search_row(s, row, shares, rows, -count);
}

/* Whether h may be lower on chord k than at all ticks, judged by its change there and on both neighbours. */
static int may_be_lower(const double *table, int m, int chords, int k, const double *least)
{
    for (int r = 0; r < m; r++) {
        double bound = fabs(table[(k + 1) * m + r] - table[k * m + r]);
        if (k > 0) bound = maximum(bound, fabs(table[k * m + r] - table[(k - 1) * m + r]));
        if (k + 1 < chords) bound = maximum(bound, fabs(table[(k + 2) * m + r] - table[(k + 1) * m + r]));
        if (0.5 * (table[k * m + r] + table[(k + 1) * m + r]) - 0.5 * GRADIENT_FACTOR * bound < least[r]) return 1;
    }
    return 0;
}

static void minimum_along(const setup *u, const double *path, int count, int always, double *memory, int *flags,
                          double *values, int *points, double *shares, double *size)
{
    const int m = u->rows, chords = count - 1;
    double *table = memory, *least = memory + count * m, *row_values = least + m, *rest = row_values + m;
    for (int i = 0; i < count; i++) h(u, path + i * STATES, table + i * m);
    for (int r = 0; r < m; r++) {
        points[r] = 0;
        shares[r] = 0.0;
        size[r] = 0.0;
        for (int i = 0; i < count; i++) size[r] = maximum(size[r], fabs(table[i * m + r]));
        if (!(size[r] > 0.0)) size[r] = 1.0;
        for (int i = 0; i < count; i++) {
            if (table[i * m + r] != table[i * m + r]) { points[r] = i; break; }
            if (table[i * m + r] < table[points[r] * m + r]) points[r] = i;
        }
        values[r] = least[r] = table[points[r] * m + r];
        flags[r] = values[r] != values[r];
    }
    for (int k = 0; k < chords; k++) {
        if (memcmp(path + k * STATES, path + (k + 1) * STATES, STATES * sizeof(double)) == 0) continue;
        if (chords > SHORT_PATH && k >= always && !may_be_lower(table, m, chords, k, least)) continue;
        const search s = {u, path, k, values, shares, row_values, points, flags};
        search_chord(&s, table, rest);
    }
    for (int r = 0; r < m; r++) if (flags[r]) values[r] = NAN;
}

/* The doubles that rollout needs for memory. */
EXPORTED int memory_size(const setup *u)
{
    return (u->ticks + 2) * (STATES + u->rows) + (SAMPLES + 8) * u->rows + 3 * STATES + 8;
}

/* One caller's arrays: what goes in, and what comes out. */
typedef struct {
    setup u;
    const double *origin, *x, *directions;
    double *path, *memory, *values, *shares, *size, *out;
    int *flags, *points;
} call;

/* H at x: the path (from origin, if it is not NULL), the minimum and point of each row, and the size of h.
Returns the number of states on the path, or NOT_FINITE. */
static int rollout(const setup *u, const double *origin, const double *x, double *path, double *memory, int *flags,
                     double *values, int *points, double *shares, double *size)
{
    const int first = origin != NULL;
    if (first) memcpy(path, origin, STATES * sizeof(double));
    const int count = follow(u, x, u->ticks, path + first * STATES);
    if (count < 0) return count;
    minimum_along(u, path, first + count, first, memory, flags, values, points, shares, size);
    return first + count;
}

/* h at the same points of the path from another state. Returns 0, or NOT_FINITE. */
static int h_near(const setup *u, const double *origin, const double *x, const int *points, const double *shares,
                    double *memory, double *out)
{
    const int first = origin != NULL, m = u->rows;
    int last = 0;
    for (int r = 0; r < m; r++) {
        const int needed = points[r] + (shares[r] > 0.0) - first;
        if (needed > last) last = needed;
    }
    double *path = memory, *row_values = memory + (u->ticks + 2) * STATES;
    if (first) memcpy(path, origin, STATES * sizeof(double));
    const int found = follow(u, x, last, path + first * STATES);
    if (found < 0) return found;
    const int count = first + found;
    for (int r = 0; r < m; r++) {
        int same = r;
        for (int q = 0; q < r && same == r; q++)
            if (points[q] == points[r] && shares[q] == shares[r]) same = q;
        /* rows with one common point share an evaluation, which is still in row_values if they follow each other */
        if (same == r || r == 0 || points[r - 1] != points[r] || shares[r - 1] != shares[r]) {
            double state[STATES];
            if (points[r] + 1 >= count)
                memcpy(state, path + (count - 1) * STATES, sizeof state);
            else
                chord_point(path, points[r], shares[r], state);
            h(u, state, row_values);
        }
        out[r] = row_values[r];
    }
    return 0;
}

/* d(H)/d(u) (rows, columns) at x + directions (columns, STATES) u by central differences. Returns 0, or NOT_FINITE. */
static int lie_differences(const setup *u, const double *origin, const double *x, const int *points,
                             const double *shares, const double *directions, int columns, double *memory, double *out)
{
    const int m = u->rows;
    double ahead[STATES], *up = memory, *down = memory + m, *rest = memory + 2 * m;
    for (int c = 0; c < columns; c++) {
        const double *d = directions + c * STATES;
        int moves = 0;
        for (int j = 0; j < STATES; j++) moves |= d[j] != 0.0;
        for (int r = 0; r < m && !moves; r++) out[r * columns + c] = 0.0;
        if (!moves) continue;
        for (int j = 0; j < STATES; j++) ahead[j] = x[j] + STEP_SHARE * d[j];
        if (h_near(u, origin, ahead, points, shares, rest, up) < 0) return NOT_FINITE;
        for (int j = 0; j < STATES; j++) ahead[j] = x[j] - STEP_SHARE * d[j];
        if (h_near(u, origin, ahead, points, shares, rest, down) < 0) return NOT_FINITE;
        for (int r = 0; r < m; r++) out[r * columns + c] = (up[r] - down[r]) / (2.0 * STEP_SHARE);
    }
    return 0;
}

#ifdef DERIVATIVES
/* d(H)/d(x) (rows, STATES) by the chain rule along a path of ``count`` states. */
static int gradient(const setup *u, int first, const double *path, int count, const int *points, const double *shares,
                      double *out)
{
    int last = 0;
    for (int r = 0; r < u->rows; r++) if (points[r] > last) last = points[r];
    double now[STATES * STATES] = {0.0}, next[STATES * STATES], own[STATES * STATES];
    if (!first)
        for (int j = 0; j < STATES; j++) now[j * STATES + j] = 1.0;
    for (int k = 0; k <= last && k < count; k++) {
        const int moved = k + 1 < count;
        if (moved && k < first) {
            /* the origin is measured: the sensitivity begins with the state after it */
            for (int j = 0; j < STATES * STATES; j++) next[j] = 0.0;
            for (int j = 0; j < STATES; j++) next[j * STATES + j] = 1.0;
        } else if (moved) {
            step_slopes(u, path + k * STATES, own);
            for (int i = 0; i < STATES; i++)
                for (int j = 0; j < STATES; j++) {
                    double sum = 0.0;
                    for (int l = 0; l < STATES; l++) sum += own[i * STATES + l] * now[l * STATES + j];
                    next[i * STATES + j] = sum;
                }
        }
        for (int r = 0; r < u->rows; r++) {
            if (points[r] != k) continue;
            double x[STATES], slope[STATES];
            chord_point(path, k, shares[r], x);
            h_slopes(u, x, r, slope);
            for (int j = 0; j < STATES; j++) {
                double sum = 0.0;
                for (int l = 0; l < STATES; l++) {
                    const double here = now[l * STATES + j];
                    sum += slope[l] * (shares[r] == 0.0 ? here : (1.0 - shares[r]) * here + shares[r] * next[l * STATES + j]);
                }
                out[r * STATES + j] = sum;
            }
        }
        memcpy(now, next, sizeof now);
    }
    return 0;
}
#endif

EXPORTED int call_rollout(const call *c, int from_origin)
{
    return rollout(&c->u, from_origin ? c->origin : NULL, c->x, c->path, c->memory, c->flags, c->values, c->points,
                   c->shares, c->size);
}

EXPORTED int call_h_near(const call *c, int from_origin)
{
    return h_near(&c->u, from_origin ? c->origin : NULL, c->x, c->points, c->shares, c->memory, c->out);
}

EXPORTED int call_lie_differences(const call *c, int from_origin, int columns)
{
    return lie_differences(&c->u, from_origin ? c->origin : NULL, c->x, c->points, c->shares, c->directions, columns,
                           c->memory, c->out);
}

EXPORTED int call_gradient(const call *c, int from_origin, int count)
{
#ifdef DERIVATIVES
    return gradient(&c->u, from_origin, c->path, count, c->points, c->shares, c->out);
#else
    (void)c; (void)from_origin; (void)count;
    return NOT_FINITE;
#endif
}
