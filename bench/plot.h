/* SPDX-License-Identifier: MIT-0
   plot.h - line and dot plots as SVG, for the benchmarks. Include it after common.h.

       plot p = plot_begin("Cost against resolution", "fox; one thread", 2);      // two panels side by side
       plot_panel *a = plot_add_panel(&p, "time", "pixels along a side", "seconds", PLOT_LOG_X | PLOT_LOG_Y);
       plot_series *s = plot_add_series(a, "guarded");
       plot_point *q = plot_add(s, 64, 0.02);
       q->y_low = 0.018, q->y_high = 0.025, q->open = 1;                          // a spread; a failure
       plot_write(&p, "growth.svg", "machine and commit");

   A name has one color and one marker in all panels of a plot, in the order in which names first come; the legend is at
   the right. Open markers are failures (p.open_means says of what). On a log axis what is 0 or less, or less than
   a->least, is drawn at the low edge, which is marked so; what is not finite is drawn open at the high edge: nothing is
   dropped. plot_category gives the y axis names instead of numbers. Texts are UTF-8 and may hold any character.
   Pointers are good until the next one of the same kind is added; plot_write frees all. */
#ifndef DIST_BENCH_PLOT_H
#define DIST_BENCH_PLOT_H

enum {
    PLOT_LOG_X = 1,
    PLOT_LOG_Y = 2,
    PLOT_TWO_X = 4,    /* with PLOT_LOG_X: ticks at the powers of 2 */
    PLOT_ZERO_Y = 8,   /* a linear y axis starts at 0 */
    PLOT_WHOLE_X = 16, /* ticks at whole numbers only */

    PLOT_CIRCLE = 1, /* markers; 0: by the series' place */
    PLOT_SQUARE,
    PLOT_UP,
    PLOT_DIAMOND,
    PLOT_DOWN,
    PLOT_HEXAGON,
    PLOT_STAR,
    PLOT_NO_MARKER,
    PLOT_MARKERS = PLOT_STAR
};

typedef struct plot_point {
    double x, y;
    double x_low, x_high, y_low, y_high; /* spread; low == high: none is drawn */
    int open;                            /* a failure */
    double size;                         /* of the marker, times the usual one */
} plot_point;

typedef struct plot_series {
    const char *name;    /* borrowed */
    int style;           /* which color and marker, from 0: set from the name */
    int marker;          /* PLOT_CIRCLE ..., instead of the style's */
    int dashed, no_line; /* the line that joins the points in the order of their adding */
    int hidden;          /* not in the legend */
    size_t n, room;
    plot_point *points;
} plot_series;

typedef struct plot_panel {
    const char *title, *x_label, *y_label; /* borrowed */
    int flags;
    double least[2];    /* x, y on a log axis: what is less is drawn at the edge; 0: no bound */
    double guide;       /* with guide_text: a dashed line at this value, of x where y has categories, else of y */
    const char *guide_text;
    const char **categories;
    int category_count;
    plot_series *series;
    size_t n, room;
    /* set by plot_write */
    double low[2], high[2], edge[2]; /* of the axes, as exponents on a log one; edge: 1 where points lie below */
    double left, top, width, height;
} plot_panel;

typedef struct plot {
    const char *title, *subtitle, *open_means; /* borrowed; open_means NULL: "failed" */
    const char *notes[6];                      /* further lines under the legend; NULL: end */
    int columns;
    double panel_width, panel_height; /* of the axes' box, pixels; before plot_write */
    plot_panel *panels;
    size_t n, room;
    const char *names[64]; /* of the legend */
    int name_count;
} plot;

/* ---- building ---------------------------------------------------------------------------------------------------- */

static inline plot plot_begin(const char *title, const char *subtitle, int columns)
{
    plot p;
    memset(&p, 0, sizeof p);
    p.title = title;
    p.subtitle = subtitle;
    p.columns = columns;
    p.panel_width = 300;
    p.panel_height = 210;
    return p;
}

/* Room for one item more, zeroed; returns the new place of all. */
static inline void *plot_room(void *items, size_t n, size_t *room, size_t bytes)
{
    if (n < *room) { return items; }
    size_t more = 2 * *room + 8;
    char *place = (char *)realloc(items, more * bytes);
    if (!place) { fail("out of memory: a plot"); }
    memset(place + n * bytes, 0, (more - n) * bytes);
    *room = more;
    return place;
}

static inline plot_panel *plot_add_panel(plot *p, const char *title, const char *x_label, const char *y_label,
                                         int flags)
{
    p->panels = (plot_panel *)plot_room(p->panels, p->n, &p->room, sizeof *p->panels);
    plot_panel *panel = &p->panels[p->n++];
    panel->title = title;
    panel->x_label = x_label;
    panel->y_label = y_label;
    panel->flags = flags;
    return panel;
}

static inline plot_series *plot_add_series(plot_panel *panel, const char *name)
{
    panel->series = (plot_series *)plot_room(panel->series, panel->n, &panel->room, sizeof *panel->series);
    plot_series *s = &panel->series[panel->n++];
    s->name = name;
    s->style = -1;
    return s;
}

/* The panel's series of that name, made where there is none. */
static inline plot_series *plot_series_of(plot_panel *panel, const char *name)
{
    for (size_t i = 0; i < panel->n; i++) {
        if (strcmp(panel->series[i].name, name) == 0) { return &panel->series[i]; }
    }
    return plot_add_series(panel, name);
}

static inline plot_point *plot_add(plot_series *s, double x, double y)
{
    s->points = (plot_point *)plot_room(s->points, s->n, &s->room, sizeof *s->points);
    plot_point *q = &s->points[s->n++];
    q->x = x;
    q->y = y;
    q->size = 1;
    return q;
}

/* The y of a name (borrowed) on an axis of names, from the top down: 0, 1, 2 ... */
static inline double plot_category(plot_panel *panel, const char *name)
{
    for (int i = 0; i < panel->category_count; i++) {
        if (strcmp(panel->categories[i], name) == 0) { return i; }
    }
    size_t bytes = ((size_t)panel->category_count + 1) * sizeof *panel->categories;
    panel->categories = (const char **)realloc((void *)panel->categories, bytes);
    if (!panel->categories) { fail("out of memory: a plot"); }
    panel->categories[panel->category_count] = name;
    return panel->category_count++;
}

/* ---- text -------------------------------------------------------------------------------------------------------- */

/* Pixels that a text takes at that size of font, a little more than less. */
static inline double plot_text_width(const char *text, double size)
{
    double n = 0;
    for (const char *c = text; *c; c++) {
        int narrow = strchr("iljtfrI1.,:;'|!()[] ", *c) != NULL;
        n += ((unsigned char)*c & 0xC0) == 0x80 ? 0 : narrow ? 0.4 : *c < 'a' ? 0.7 : 0.64;
    }
    return n * size;
}

static inline void plot_escaped(FILE *f, const char *text)
{
    for (; *text; text++) {
        if (*text == '<') {
            fputs("&lt;", f);
        } else if (*text == '>') {
            fputs("&gt;", f);
        } else if (*text == '&') {
            fputs("&amp;", f);
        } else {
            fputc(*text, f);
        }
    }
}

/* anchor: start, middle or end. */
static inline void plot_text(FILE *f, double x, double y, const char *anchor, const char *more, const char *text)
{
    fprintf(f, "<text x='%.1f' y='%.1f' text-anchor='%s'%s>", x, y, anchor, more);
    plot_escaped(f, text);
    fputs("</text>\n", f);
}

/* Breaks a text at spaces into lines no wider than that; returns y under the last one. */
static inline double plot_wrapped(FILE *f, double x, double y, double width, double size, const char *more,
                                  const char *text)
{
    char line[1024];
    while (*text) {
        size_t end = 0; /* as much as fits, at least one word */
        for (size_t i = 1; i < sizeof line; i++) {
            if (text[i] != ' ' && text[i] != 0) { continue; }
            memcpy(line, text, i);
            line[i] = 0;
            if (end && plot_text_width(line, size) > width) { break; }
            end = i;
            if (text[i] == 0) { break; }
        }
        if (end == 0) { end = strlen(text) < sizeof line ? strlen(text) : sizeof line - 1; }
        memcpy(line, text, end);
        line[end] = 0;
        plot_text(f, x, y, "start", more, line);
        y += 1.3 * size;
        text += end;
        while (*text == ' ') { text++; }
    }
    return y;
}

static inline int plot_is_plain(double value)
{
    return value == 0 || (fabs(value) > 0.99e-3 && fabs(value) < 1e5);
}

/* As it is, or as a power of ten. */
static inline void plot_number(FILE *f, double value, int plain)
{
    double size = fabs(value);
    double exponent = size > 0 ? floor(log10(size) + 1e-9) : 0;
    if (plain || value == 0) {
        fprintf(f, "%.6g", value);
        return;
    }
    double digits = value / pow(10, exponent);
    if (fabs(digits - 1) > 1e-6) { fprintf(f, "%.3g&#183;", digits); }
    fprintf(f, "10<tspan dy='-4' font-size='8'>%s%.0f</tspan>", exponent < 0 ? "&#8722;" : "", fabs(exponent));
}

/* ---- axes -------------------------------------------------------------------------------------------------------- */

static inline int plot_is_log(const plot_panel *a, int axis)
{
    return (a->flags & (axis ? PLOT_LOG_Y : PLOT_LOG_X)) != 0;
}

static inline int plot_finite(double v)
{
    return v >= -1e300 && v <= 1e300;
}

/* Widens low..high of an axis by one value; values that a log axis cannot show only mark the edge. */
static inline void plot_widen(plot_panel *a, int axis, double v)
{
    if (!plot_finite(v)) { return; }
    if (plot_is_log(a, axis)) {
        if (v <= 0 || v < a->least[axis]) {
            a->edge[axis] = 1;
            return;
        }
        v = log10(v);
    }
    a->low[axis] = v < a->low[axis] ? v : a->low[axis];
    a->high[axis] = v > a->high[axis] ? v : a->high[axis];
}

static inline void plot_range(plot_panel *a)
{
    for (int axis = 0; axis < 2; axis++) {
        a->low[axis] = 1e300;
        a->high[axis] = -1e300;
        a->edge[axis] = 0;
    }
    for (size_t k = 0; k < a->n; k++) {
        for (size_t i = 0; i < a->series[k].n; i++) {
            const plot_point *q = &a->series[k].points[i];
            plot_widen(a, 0, q->x);
            plot_widen(a, 1, q->y);
            if (q->x_low < q->x_high) { plot_widen(a, 0, q->x_low), plot_widen(a, 0, q->x_high); }
            if (q->y_low < q->y_high) { plot_widen(a, 1, q->y_low), plot_widen(a, 1, q->y_high); }
        }
    }
    if (a->guide_text) { plot_widen(a, a->category_count ? 0 : 1, a->guide); }
    if (a->flags & PLOT_ZERO_Y) { plot_widen(a, 1, 0); }
    for (int axis = 0; axis < 2; axis++) {
        int is_log = plot_is_log(a, axis);
        double *low = &a->low[axis];
        double *high = &a->high[axis];
        if (axis == 1 && a->category_count) { /* row 0 is at the top */
            *low = a->category_count - 0.5, *high = -0.5;
            continue;
        }
        if (*low > *high) { /* nothing to show */
            *low = is_log && a->least[axis] > 0 ? log10(a->least[axis]) : 0;
            *high = *low + 1;
        }
        double pad = 0.04 * (*high - *low);
        double span = is_log ? 0.3 : 1e-3 * fabs(*high) + 1e-12;
        if (*high - *low < span) { pad = 0.5 * (span - (*high - *low)); }
        *high += pad;
        if (is_log && a->edge[axis] != 0.0) {
            *low = a->least[axis] > 0 ? log10(a->least[axis]) : floor(*low - 0.5);
        } else if (is_log || !(a->flags & PLOT_ZERO_Y && axis == 1 && *low >= 0)) {
            *low -= pad;
        }
    }
}

/* Where a value lies on the picture. */
static inline double plot_at(const plot_panel *a, int axis, double v)
{
    double low = a->low[axis];
    double high = a->high[axis];
    double at = 1;
    if (plot_finite(v)) {
        v = !plot_is_log(a, axis) ? v : v > 0 ? log10(v) : -1e300;
        at = (v - low) / (high - low);
        at = at < 0 ? 0 : at > 1 ? 1 : at;
    }
    return axis ? a->top + (1 - at) * a->height : a->left + at * a->width;
}

/* Values of the ticks of an axis; returns how many. */
static inline int plot_ticks(const plot_panel *a, int axis, double ticks[32])
{
    double low = a->low[axis];
    double high = a->high[axis];
    int n = 0;
    if (!plot_is_log(a, axis) || high - low < 0.7) { /* even steps; on a short log axis, of the values */
        int is_log = plot_is_log(a, axis);
        double from = is_log ? pow(10, low) : low;
        double to = is_log ? pow(10, high) : high;
        double step = tick_step(to - from);
        if (axis == 0 && a->flags & PLOT_WHOLE_X) { step = fmax(step, 1); }
        for (double v = ceil(from / step - 1e-9) * step; v <= to + 1e-9 * step && n < 32; v += step) {
            ticks[n++] = fabs(v) < 1e-9 * step ? 0 : v;
        }
        if (!(a->flags & PLOT_TWO_X) || axis) { return n; }
        n = 0;
    }
    if (axis == 0 && a->flags & PLOT_TWO_X) {
        double bit = log10(2.0);
        for (double e = ceil(low / bit - 1e-9); e <= high / bit && n < 32; e++) { ticks[n++] = pow(2, e); }
        return n;
    }
    double each = ceil((high - low) / (axis ? 7.0 : 6.0)); /* decades from tick to tick */
    for (double e = floor(low); e <= high && n < 30; e += each) {
        if (e >= low - 1e-9) { ticks[n++] = pow(10, e); }
        for (int k = 2; k <= 5 && high - low < 2.2; k += 3) {
            double v = k * pow(10, e);
            if (log10(v) >= low && log10(v) <= high) { ticks[n++] = v; }
        }
    }
    return n;
}

/* Grid, numbers, names and the guide. */
static inline void plot_axes(FILE *f, const plot_panel *a)
{
    double ticks[32];
    double right = a->left + a->width;
    double bottom = a->top + a->height;
    int n = plot_ticks(a, 0, ticks);
    int plain = 1; /* all numbers of an axis alike */
    for (int i = 0; i < n; i++) { plain &= plot_is_plain(ticks[i]); }
    double taken = -1e30; /* up to here by the last number */
    for (int i = 0; i < n; i++) {
        char number[32];
        snprintf(number, sizeof number, "%.6g", ticks[i]);
        double exponent = log10(fabs(ticks[i]) + 1e-300);
        int round = fabs(exponent - floor(exponent + 0.5)) < 1e-6;
        double half = plain ? 0.5 * plot_text_width(number, 11) : round ? 14 : 24;
        double x = plot_at(a, 0, ticks[i]);
        fprintf(f, "<path d='M%.1f %.1fV%.1f' stroke='#e4e4e4'/>", x, a->top, bottom);
        if ((a->edge[0] != 0.0 && x < a->left + 28) || x - half < taken + 4) { continue; } /* the edge's own word is there */
        taken = x + half;
        fprintf(f, "<text x='%.1f' y='%.1f' text-anchor='middle'>", x, bottom + 15);
        plot_number(f, ticks[i], plain);
        fputs("</text>\n", f);
    }
    n = a->category_count ? a->category_count : plot_ticks(a, 1, ticks);
    plain = 1;
    for (int i = 0; i < n && !a->category_count; i++) { plain &= plot_is_plain(ticks[i]); }
    for (int i = 0; i < n; i++) {
        double y = plot_at(a, 1, a->category_count ? i : ticks[i]);
        fprintf(f, "<path d='M%.1f %.1fH%.1f' stroke='#e4e4e4'/>", a->left, y, right);
        if (a->category_count) {
            plot_text(f, a->left - 7, y + 4, "end", "", a->categories[i]);
            continue;
        }
        if (a->edge[1] != 0.0 && y > bottom - 10) { continue; }
        fprintf(f, "<text x='%.1f' y='%.1f' text-anchor='end'>", a->left - 6, y + 4);
        plot_number(f, ticks[i], plain);
        fputs("</text>\n", f);
    }
    for (int axis = 0; axis < 2; axis++) {
        if (a->edge[axis] == 0.0) { continue; }
        fprintf(f, "<text x='%.1f' y='%.1f' text-anchor='%s'>", axis ? a->left - 6 : a->left,
                axis ? bottom + 4 : bottom + 15, axis ? "end" : "middle");
        if (a->least[axis] > 0) {
            fputs("&#8804;", f);
            plot_number(f, a->least[axis], plot_is_plain(a->least[axis]));
        } else {
            fputs("0", f);
        }
        fputs("</text>\n", f);
    }
    fprintf(f, "<rect x='%.1f' y='%.1f' width='%.1f' height='%.1f' fill='none' stroke='#555'/>\n", a->left, a->top,
            a->width, a->height);
    if (a->guide_text) {
        if (a->category_count) {
            double x = plot_at(a, 0, a->guide);
            int end = x > a->left + 0.5 * a->width;
            fprintf(f, "<path d='M%.1f %.1fV%.1f' stroke='#555' stroke-dasharray='2 3'/>", x, a->top, bottom);
            plot_text(f, end ? x - 4 : x + 4, a->top + 12, end ? "end" : "start", " fill='#555' font-size='10'",
                      a->guide_text);
        } else {
            double y = plot_at(a, 1, a->guide);
            fprintf(f, "<path d='M%.1f %.1fH%.1f' stroke='#555' stroke-dasharray='2 3'/>", a->left, y, right);
            plot_text(f, a->left + 5, y < a->top + 20 ? y + 12 : y - 4, "start", " fill='#555' font-size='10'",
                      a->guide_text);
        }
    }
    plot_text(f, 0.5 * (a->left + right), a->top - 9, "middle", " font-weight='bold' font-size='12'", a->title);
    if (a->x_label) { plot_text(f, 0.5 * (a->left + right), bottom + 32, "middle", "", a->x_label); }
    if (a->y_label && !a->category_count) {
        char turn[96];
        snprintf(turn, sizeof turn, " transform='rotate(-90 %.1f %.1f)'", a->left - 46, a->top + 0.5 * a->height);
        plot_text(f, a->left - 46, a->top + 0.5 * a->height, "middle", turn, a->y_label);
    }
}

/* ---- series ------------------------------------------------------------------------------------------------------ */

/* Colors that are told apart in print and by color-blind eyes; the marker changes with them. */
static inline const char *plot_color(int style)
{
    static const char colors[12][8] = {"#0072b2", "#d55e00", "#009e73", "#aa3377", "#e0a000", "#56a8dd",
                                       "#333333", "#8c564b", "#7f7f00", "#6a3fb5", "#17becf", "#e377c2"};
    return colors[style % 12];
}

static inline int plot_marker_of(const plot_series *s)
{
    return s->marker ? s->marker : 1 + (s->style + s->style / 12 * 3) % PLOT_MARKERS;
}

/* The outline of a marker, to be put into a path. */
static inline void plot_shape(FILE *f, int marker, double x, double y, double r)
{
    static const double sizes[PLOT_MARKERS] = {1, 0.88, 1.2, 1.2, 1.2, 1.1, 1.35};
    r *= sizes[marker - 1];
    if (marker == PLOT_CIRCLE) {
        fprintf(f, "M%.1f %.1fa%.1f %.1f 0 1 0 %.1f 0a%.1f %.1f 0 1 0 %.1f 0z", x - r, y, r, r, 2 * r, r, r, -2 * r);
        return;
    }
    int triangle = marker == PLOT_UP || marker == PLOT_DOWN;
    int corners = triangle ? 3 : marker == PLOT_HEXAGON ? 6 : marker == PLOT_STAR ? 10 : 4;
    double first = marker == PLOT_SQUARE ? 45 : marker == PLOT_DOWN ? 90 : -90;
    if (marker == PLOT_SQUARE) { r *= 1.414; }
    for (int i = 0; i < corners; i++) {
        double angle = (first + 360.0 * i / corners) * 3.14159265358979 / 180;
        double at = marker == PLOT_STAR && i % 2 ? 0.45 * r : r;
        fprintf(f, "%s%.1f %.1f", i ? "L" : "M", x + at * cos(angle), y + at * sin(angle));
    }
    fputs("z", f);
}

static inline void plot_draw_series(FILE *f, const plot_panel *a, const plot_series *s)
{
    const char *color = plot_color(s->style);
    if (!s->no_line && s->n > 1) {
        fprintf(f, "<path fill='none' stroke='%s' stroke-width='1.5' stroke-linejoin='round'%s d='", color,
                s->dashed ? " stroke-dasharray='5 3'" : "");
        for (size_t i = 0; i < s->n; i++) {
            const plot_point *q = &s->points[i];
            fprintf(f, "%s%.1f %.1f", i ? "L" : "M", plot_at(a, 0, q->x), plot_at(a, 1, q->y));
        }
        fputs("'/>\n", f);
    }
    int spread = 0;
    for (size_t i = 0; i < s->n; i++) {
        const plot_point *q = &s->points[i];
        double x = plot_at(a, 0, q->x);
        double y = plot_at(a, 1, q->y);
        if (!(q->x_low < q->x_high) && !(q->y_low < q->y_high)) { continue; }
        if (!spread++) { fprintf(f, "<path fill='none' stroke='%s' stroke-opacity='0.6' d='", color); }
        if (q->x_low < q->x_high) {
            fprintf(f, "M%.1f %.1fH%.1f", plot_at(a, 0, q->x_low), y, plot_at(a, 0, q->x_high));
        }
        if (q->y_low < q->y_high) {
            fprintf(f, "M%.1f %.1fV%.1f", x, plot_at(a, 1, q->y_low), plot_at(a, 1, q->y_high));
        }
    }
    if (spread) { fputs("'/>\n", f); }
    for (int open = 0; open < 2 && plot_marker_of(s) != PLOT_NO_MARKER; open++) {
        int any = 0;
        for (size_t i = 0; i < s->n; i++) {
            const plot_point *q = &s->points[i];
            if ((q->open || !plot_finite(q->x) || !plot_finite(q->y)) != open) { continue; }
            if (!any++) {
                fprintf(f, "<path fill='%s' stroke='%s' stroke-width='1.1' d='", open ? "white" : color, color);
            }
            plot_shape(f, plot_marker_of(s), plot_at(a, 0, q->x), plot_at(a, 1, q->y), 3.2 * q->size);
        }
        if (any) { fputs("'/>\n", f); }
    }
}

/* ---- the picture ------------------------------------------------------------------------------------------------- */

/* Gives every name its style; returns whether a point is open. */
static inline int plot_styles(plot *p)
{
    int open = 0;
    for (size_t k = 0; k < p->n; k++) {
        for (size_t i = 0; i < p->panels[k].n; i++) {
            plot_series *s = &p->panels[k].series[i];
            int j = 0;
            for (size_t m = 0; m < s->n; m++) {
                open |= s->points[m].open || !plot_finite(s->points[m].x) || !plot_finite(s->points[m].y);
            }
            while (j < p->name_count && strcmp(p->names[j], s->name) != 0) { j++; }
            if (j == p->name_count && !s->hidden) {
                if (j == (int)(sizeof p->names / sizeof p->names[0])) { fail("%s: too many series", p->title); }
                p->names[p->name_count++] = s->name;
            }
            if (s->style < 0) { s->style = j; }
        }
    }
    return open;
}

static inline const plot_series *plot_series_named(const plot *p, const char *name)
{
    for (size_t k = 0; k < p->n; k++) {
        for (size_t i = 0; i < p->panels[k].n; i++) {
            const plot_series *s = &p->panels[k].series[i];
            if (!s->hidden && strcmp(s->name, name) == 0) { return s; }
        }
    }
    return NULL;
}

static inline void plot_legend(FILE *f, const plot *p, double x, double y, double width, int open)
{
    for (int k = 0; k < p->name_count; k++) {
        const plot_series *s = plot_series_named(p, p->names[k]);
        const char *color = plot_color(s->style);
        if (!s->no_line) {
            fprintf(f, "<path d='M%.1f %.1fh26' stroke='%s' stroke-width='1.5'%s/>", x, y - 4, color,
                    s->dashed ? " stroke-dasharray='5 3'" : "");
        }
        if (plot_marker_of(s) != PLOT_NO_MARKER) {
            fprintf(f, "<path fill='%s' stroke='%s' d='", color, color);
            plot_shape(f, plot_marker_of(s), x + 13, y - 4, 3.4);
            fputs("'/>", f);
        }
        plot_text(f, x + 33, y, "start", "", p->names[k]);
        y += 17;
    }
    y += 8;
    if (open) {
        fprintf(f, "<path fill='white' stroke='#333' d='");
        plot_shape(f, PLOT_CIRCLE, x + 13, y - 4, 3.4);
        fputs("'/>", f);
        y = plot_wrapped(f, x + 33, y, width - 33, 11, "", p->open_means ? p->open_means : "failed") + 3;
    }
    for (int k = 0; k < 6 && p->notes[k]; k++) { y = plot_wrapped(f, x, y, width, 11, "", p->notes[k]) + 3; }
}

/* Writes the file and frees the plot. origin: machine and commit, in small print at the foot; NULL: nothing there. */
static inline void plot_write(plot *p, const char *path, const char *origin)
{
    int open = plot_styles(p);
    double gutter = 66;
    double legend = 150;
    for (size_t k = 0; k < p->n; k++) {
        for (int i = 0; i < p->panels[k].category_count; i++) {
            gutter = fmax(gutter, plot_text_width(p->panels[k].categories[i], 11) + 16);
        }
    }
    for (int k = 0; k < p->name_count; k++) { legend = fmax(legend, plot_text_width(p->names[k], 11) + 40); }
    int columns = p->columns < (int)p->n ? p->columns : (int)p->n;
    int rows = columns ? ((int)p->n + columns - 1) / columns : 0;
    double across = gutter + p->panel_width + 18;
    double down = p->panel_height + 78;
    double head = p->subtitle ? 58 : 40;
    double right = columns * across;
    double tall = fmax(head + rows * down, head + 30 + 17.0 * p->name_count + 100);
    double width = right + legend + 14;
    double height = tall + (origin ? 14 * ceil(plot_text_width(origin, 9.5) / (width - 24)) + 8 : 0);
    FILE *f = open_file(path, "wb");
    fprintf(f, "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 %.0f %.0f' width='%.0f' height='%.0f' "
            "font-family='DejaVu Sans, Verdana, sans-serif' font-size='11' fill='#222'>\n"
            "<rect width='%.0f' height='%.0f' fill='white'/>\n", width, height, width, height, width, height);
    plot_text(f, 14, 24, "start", " font-size='16' font-weight='bold'", p->title);
    if (p->subtitle) { plot_text(f, 14, 42, "start", " fill='#555'", p->subtitle); }
    for (size_t k = 0; k < p->n; k++) {
        plot_panel *a = &p->panels[k];
        a->left = gutter + across * (double)((int)k % columns);
        a->top = head + 26 + down * (double)((int)k / columns);
        a->width = p->panel_width;
        a->height = p->panel_height;
        plot_range(a);
        plot_axes(f, a);
        for (size_t i = a->n; i-- > 0;) { plot_draw_series(f, a, &a->series[i]); } /* the first one on top */
    }
    plot_legend(f, p, right + 6, head + 34, legend, open);
    if (origin) { plot_wrapped(f, 14, tall + 4, width - 28, 9.5, " font-size='9.5' fill='#777'", origin); }
    fputs("</svg>\n", f);
    close_file(f, path);
    for (size_t k = 0; k < p->n; k++) {
        for (size_t i = 0; i < p->panels[k].n; i++) { free(p->panels[k].series[i].points); }
        free(p->panels[k].series);
        free((void *)p->panels[k].categories);
    }
    free(p->panels);
    memset(p, 0, sizeof *p);
}

#endif
