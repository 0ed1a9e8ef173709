/* SPDX-License-Identifier: MIT-0
   common.h - what the examples share. It is the examples' code, not the library's: copy what you like.

   Include it after dist.h. Errors end the program with one sentence on stderr and exit status 2.

   Contents: failing and clock, options, progress, random numbers, files and JSON, model, code and camera, pictures,
   error and cost, curves.
   COMMON_NO_MODEL, defined before the include, leaves out the embedded model (for the program that makes it);
   COMMON_TEXTURE adds the texture that colors it. */
#ifndef DIST_EXAMPLES_COMMON_H
#define DIST_EXAMPLES_COMMON_H

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#ifdef _WIN32
#include <direct.h>
#include <io.h>
#include <time.h>
#else
#include <sys/time.h>
#include <unistd.h>
#endif

/* stb_image_write.h is used where it can be found; without it pictures are written as PPM. The models are taken to be
   there by a compiler without __has_include. */
#ifdef __has_include
#if __has_include(<stb/stb_image_write.h>)
#define COMMON_STB <stb/stb_image_write.h>
#elif __has_include(<stb_image_write.h>)
#define COMMON_STB <stb_image_write.h>
#elif __has_include("stb_image_write.h")
#define COMMON_STB "stb_image_write.h"
#elif __has_include("../build/stb/usr/include/stb/stb_image_write.h")
#define COMMON_STB "../build/stb/usr/include/stb/stb_image_write.h"
#endif
#if !__has_include("model.h") && !defined(COMMON_NO_MODEL)
#define COMMON_NO_MODEL
#endif
#if !__has_include("model_color.h") && defined(COMMON_TEXTURE)
#undef COMMON_TEXTURE
#endif
#endif
#ifndef COMMON_NO_MODEL
#define COMMON_MODEL
#include "model.h"
#endif
#ifdef COMMON_TEXTURE
#define COMMON_MODEL_COLOR
#include "model_color.h"
#endif

#ifdef COMMON_STB
#ifdef __GNUC__
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wconversion"
#pragma GCC diagnostic ignored "-Wsign-conversion"
#pragma GCC diagnostic ignored "-Wcast-qual"
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wdouble-promotion"
#pragma GCC diagnostic ignored "-Wshadow"
#pragma GCC diagnostic ignored "-Wmissing-field-initializers"
#endif
#define STB_IMAGE_WRITE_STATIC
#define STB_IMAGE_WRITE_IMPLEMENTATION
#include COMMON_STB
#ifdef __GNUC__
#pragma GCC diagnostic pop
#endif
#endif

#define PI 3.14159265358979f
#define PATH_SIZE 1024
#ifdef __GNUC__
#define FAILS __attribute__((noreturn))
#define PRINTS __attribute__((format(printf, 1, 2)))
#else
#define FAILS
#define PRINTS
#endif

/* ---- failing, memory, clock -------------------------------------------------------------------------------------- */

static inline void fail(const char *format, ...) FAILS PRINTS;
static inline void fail(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vfprintf(stderr, format, arguments);
    va_end(arguments);
    fputc('\n', stderr);
    exit(2);
}

/* Ends the program with the library's own sentence if any call on this context has failed. */
static inline void check(const dist_context *ctx)
{
    if (dist_context_status(ctx) != DIST_OK) { fail("%s", ctx ? dist_context_message(ctx) : "out of memory"); }
}

/* Zeroed memory for count items, never NULL; give it back with free. */
static inline void *take(size_t count, size_t item_bytes)
{
    void *memory = calloc(count ? count : 1, item_bytes);
    if (!memory) { fail("out of memory: %.0f bytes asked for", (double)count * (double)item_bytes); }
    return memory;
}

static inline float *take_floats(size_t count)
{
    return (float *)take(count, sizeof(float));
}

/* Wall clock, in seconds. */
static inline double seconds_now(void)
{
#if defined(_WIN32) && defined(TIME_UTC)
    struct timespec now;
    timespec_get(&now, TIME_UTC);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
#elif defined(_WIN32)
    return (double)clock() / CLOCKS_PER_SEC; /* wall clock there, unlike elsewhere */
#else
    struct timeval now;
    gettimeofday(&now, NULL);
    return (double)now.tv_sec + 1e-6 * (double)now.tv_usec;
#endif
}

/* ---- options ----------------------------------------------------------------------------------------------------- */

/* A walk over the command line; both "--name VALUE" and "--name=VALUE" are understood:

       options o = options_begin(argc, argv, usage);
       while (option_next(&o)) {
           if (option_is(&o, "--steps")) steps = option_int(&o, 1, 1000);
           else if (option_is(&o, "--fast")) fast = option_flag(&o);
           else if (option_is_word(&o)) model = o.name;
           else option_unknown(&o);
       } */
typedef struct options {
    int argc, index;
    char **argv;
    const char *usage;
    const char *inlined; /* what stands behind '=', or NULL */
    char name[PATH_SIZE];
} options;

/* At a program's end: what was printed has arrived, or it has failed. */
static inline void finish_printing(void)
{
    if (fflush(stdout) == 0 && !ferror(stdout)) { return; }
    fputs("what was printed cannot be written in full\n", stderr);
    _Exit(2);
}

static inline options options_begin(int argc, char **argv, const char *usage)
{
    options o;
    atexit(finish_printing);
    memset(&o, 0, sizeof o);
    o.argc = argc;
    o.argv = argv;
    o.usage = usage;
    return o;
}

/* Steps to the next argument; 0 at the end. --help prints the usage and ends the program. */
static inline int option_next(options *o)
{
    o->index++;
    if (o->index >= o->argc) { return 0; }
    const char *text = o->argv[o->index];
    const char *equals = strncmp(text, "--", 2) == 0 ? strchr(text, '=') : NULL;
    size_t length = equals ? (size_t)(equals - text) : strlen(text);
    if (length >= sizeof o->name) { fail("an argument of %.0f characters is too long", (double)length); }
    memcpy(o->name, text, length);
    o->name[length] = 0;
    o->inlined = equals ? equals + 1 : NULL;
    if (strcmp(o->name, "--help") == 0 || strcmp(o->name, "-h") == 0) {
        fputs(o->usage, stdout);
        exit(0);
    }
    return 1;
}

static inline int option_is(const options *o, const char *name)
{
    return strcmp(o->name, name) == 0;
}

/* A word that is no option: a model's name, for instance. */
static inline int option_is_word(const options *o)
{
    return o->name[0] != '-';
}

static inline void option_unknown(const options *o) FAILS;
static inline void option_unknown(const options *o)
{
    fail("unknown argument %s; --help lists the options", o->name);
}

static inline int option_flag(const options *o)
{
    if (o->inlined) { fail("%s takes no value, got \"%s\"", o->name, o->inlined); }
    return 1;
}

/* The option's value; the caller keeps the pointer, which is good as long as argv. */
static inline const char *option_text(options *o)
{
    const char *value = o->inlined;
    if (!value) {
        int missing = o->index + 1 >= o->argc || strncmp(o->argv[o->index + 1], "--", 2) == 0;
        if (missing) { fail("%s needs a value", o->name); }
        value = o->argv[++o->index];
    }
    if (!value[0]) { fail("%s needs a value, got an empty one", o->name); }
    return value;
}

/* Says that an option that was given has no effect without, or beside, something else: `text`. */
static inline void option_belongs(int given, const char *name, const char *text)
{
    if (given) { fail("%s %s", name, text); }
}

static inline double option_number(options *o, double smallest, double largest)
{
    const char *text = option_text(o);
    char *end = NULL;
    double value = strtod(text, &end);
    if (end == text || *end || !(value >= smallest && value <= largest)) {
        fail("%s needs a number from %g to %g, got \"%s\"", o->name, smallest, largest, text);
    }
    return value;
}

static inline int option_int(options *o, int smallest, int largest)
{
    const char *text = option_text(o);
    char *end = NULL;
    long value = strtol(text, &end, 10);
    if (end == text || *end || value < smallest || value > largest) {
        fail("%s needs a whole number from %d to %d, got \"%s\"", o->name, smallest, largest, text);
    }
    return (int)value;
}

/* Exactly n finite numbers with commas between them. */
static inline void option_floats(options *o, int n, float *values)
{
    const char *text = option_text(o);
    const char *at = text;
    for (int i = 0; i < n; i++) {
        char *end = NULL;
        double value = strtod(at, &end);
        int good = end != at && *end == (i + 1 < n ? ',' : 0);
        if (!good) { fail("%s needs %d number%s between commas, got \"%s\"", o->name, n, n == 1 ? "" : "s", text); }
        if (!(value >= -1e9 && value <= 1e9)) { fail("%s: numbers go from -1e9 to 1e9, got \"%s\"", o->name, text); }
        values[i] = (float)value;
        at = end + 1;
    }
}

/* Weights of a sum of losses: none below 0, and what is seen, which all but the last are of, must count. */
static inline void option_weights(const options *o, int n, const float *weights)
{
    int counts = 0;
    for (int i = 0; i < n; i++) {
        if (weights[i] < 0.0f) { fail("%s must not be negative, got %g", o->name, (double)weights[i]); }
        counts |= i + 1 < n && weights[i] > 0.0f;
    }
    if (!counts) { fail("%s: with 0 for all that is seen there is nothing to fit", o->name); }
}

/* "WxH", or one number for a square. */
static inline void option_size(options *o, int *width, int *height)
{
    const char *text = option_text(o);
    char *end = NULL;
    long w = strtol(text, &end, 10);
    long h = w;
    int good = end != text;
    if (good && (*end == 'x' || *end == 'X')) {
        const char *second = end + 1;
        h = strtol(second, &end, 10);
        good = end != second;
    }
    if (!good || *end || w < 1 || h < 1 || w > 16384 || h > 16384) {
        fail("%s needs WIDTHxHEIGHT in pixels, each from 1 to 16384, got \"%s\"", o->name, text);
    }
    *width = (int)w;
    *height = (int)h;
}

/* The position of the value in a list of words, the last entry of which is NULL. */
static inline int option_choice(options *o, const char *const *words)
{
    const char *text = option_text(o);
    char list[256] = "";
    for (int i = 0; words[i]; i++) {
        if (strcmp(text, words[i]) == 0) { return i; }
        const char *between = i == 0 ? "" : words[i + 1] ? ", " : " or ";
        snprintf(list + strlen(list), sizeof list - strlen(list), "%s%s", between, words[i]);
    }
    fail("%s needs %s, got \"%s\"", o->name, list, text);
}

/* ---- progress ---------------------------------------------------------------------------------------------------- */

/* One line on a terminal with percent, a number and the time left; nothing at all in a pipe or a file. */
typedef struct progress {
    const char *what;
    double start, shown;
    int on;
} progress;

static inline progress progress_begin(const char *what)
{
    progress p;
    p.what = what;
    p.start = seconds_now();
    p.shown = 0;
#ifdef _WIN32
    p.on = _isatty(2) != 0;
#else
    p.on = isatty(2) != 0;
#endif
    return p;
}

/* name may be NULL: then there is no number. At most ten updates a second. */
static inline void progress_show(progress *p, double done, double total, const char *name, double number)
{
    double now = p->on ? seconds_now() : 0;
    if (!p->on || now - p->shown < 0.1) { return; }
    p->shown = now;
    double share = total > 0 ? done / total : 0;
    fprintf(stderr, "\r\033[K%s %3.0f %%", p->what, 100 * share);
    if (name) { fprintf(stderr, "  %s %.4g", name, number); }
    if (share > 0 && now - p->start > 0.5) { fprintf(stderr, "  %.0f s left", (now - p->start) * (1 / share - 1)); }
    fflush(stderr);
}

static inline void progress_end(progress *p)
{
    if (p->on) { fputs("\r\033[K", stderr); }
    p->on = 0;
}

/* ---- random numbers ---------------------------------------------------------------------------------------------- */

/* SplitMix64: the same numbers on every machine for one seed. */
typedef struct rng {
    unsigned long long state;
} rng;

static inline unsigned long long rng_next(rng *r)
{
    unsigned long long x = r->state += 0x9e3779b97f4a7c15ULL;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
    return x ^ (x >> 31);
}

static inline rng rng_begin(unsigned long long seed)
{
    rng r;
    r.state = seed;
    r.state = rng_next(&r); /* else a seed's numbers are another's, some draws later */
    return r;
}

/* Uniform in [0, 1). */
static inline float rng_uniform(rng *r)
{
    return (float)(rng_next(r) >> 40) * (1.0f / 16777216.0f);
}

/* Uniform in 0..n-1. */
static inline size_t rng_index(rng *r, size_t n)
{
    return (size_t)(rng_next(r) % (unsigned long long)n);
}

/* Mean 0, variance 1. */
static inline float rng_normal(rng *r)
{
    float u = 1.0f - rng_uniform(r);
    float v = rng_uniform(r);
    return sqrtf(-2.0f * logf(u)) * cosf(2.0f * PI * v);
}

/* ---- files and JSON ---------------------------------------------------------------------------------------------- */

/* stem followed by ending, in the caller's array. */
static inline const char *path_of(char path[PATH_SIZE], const char *stem, const char *ending)
{
    size_t n = strlen(stem);
    if (n + strlen(ending) >= PATH_SIZE) { fail("the name %s%s is too long", stem, ending); }
    memcpy(path, stem, n);
    strcpy(path + n, ending);
    return path;
}

static inline int path_ends_with(const char *path, const char *ending)
{
    size_t n = strlen(path);
    size_t m = strlen(ending);
    return n >= m && strcmp(path + n - m, ending) == 0;
}

/* Makes the folders that a file's name asks for, so that "--out pictures/cow" works in an empty place. */
static inline void make_folders(const char *path)
{
    char part[PATH_SIZE];
    path_of(part, path, "");
    for (char *at = part + 1; part[0] && *at; at++) {
        if (*at != '/') { continue; }
        *at = 0;
#ifdef _WIN32
        (void)_mkdir(part);
#else
        (void)mkdir(part, 0777);
#endif
        *at = '/';
    }
}

static inline FILE *open_file(const char *path, const char *mode)
{
    FILE *file = fopen(path, mode);
    if (!file) { fail("%s cannot be %s", path, mode[0] == 'r' ? "read" : "written"); }
    return file;
}

static inline void close_file(FILE *file, const char *path)
{
    int bad = ferror(file);
    if (fclose(file) != 0 || bad) { fail("%s cannot be written in full", path); }
}

#ifndef S_ISDIR
#define S_ISDIR(mode) (((mode) & S_IFMT) == S_IFDIR)
#endif

static inline int is_folder(const char *path)
{
    struct stat about;
    return stat(path, &about) == 0 && S_ISDIR(about.st_mode);
}

/* Tries whether a file can be written, and makes its folders: better known before the work than after. */
static inline void check_path(const char *path)
{
    struct stat about;
    make_folders(path);
    int there = stat(path, &about) == 0;
    fclose(open_file(path, "ab"));
    if (!there) { remove(path); }
}

/* As above for the files STEM.json and so on. */
static inline void check_stem(const char *stem)
{
    char path[PATH_SIZE];
    size_t length = strlen(stem);
    if (length == 0 || stem[length - 1] == '/' || is_folder(stem)) {
        fail("--out \"%s\" is a folder: name the files, too", stem);
    }
    check_path(path_of(path, stem, ".json"));
}

/* All bytes of a file with a zero behind them; give them back with free. */
static inline unsigned char *read_file(const char *path, size_t *size)
{
    FILE *file = open_file(path, "rb");
    size_t room = 65536;
    size_t used = 0;
    unsigned char *bytes = (unsigned char *)take(room, 1);
    for (;;) {
        used += fread(bytes + used, 1, room - 1 - used, file);
        if (used < room - 1) { break; }
        room *= 2;
        unsigned char *larger = (unsigned char *)realloc(bytes, room);
        if (!larger) { fail("out of memory while %s is read", path); }
        bytes = larger;
    }
    if (ferror(file)) { fail("%s cannot be read", path); }
    fclose(file);
    bytes[used] = 0;
    *size = used;
    return bytes;
}

/* A JSON file of nested objects, written as it comes. */
typedef struct json {
    FILE *file;
    const char *path;
    int depth;
    int count; /* entries so far in the object that is open */
} json;

static inline void json_key(json *j, const char *key)
{
    fprintf(j->file, "%s\n%*s", j->count++ ? "," : "", 2 * j->depth, "");
    if (key) { fprintf(j->file, "\"%s\": ", key); }
}

static inline json json_open(const char *path)
{
    json j;
    j.file = open_file(path, "wb");
    j.path = path;
    j.depth = 1;
    j.count = 0;
    fputc('{', j.file);
    return j;
}

static inline void json_close(json *j)
{
    fputs("\n}\n", j->file);
    close_file(j->file, j->path);
}

static inline void json_begin(json *j, const char *key)
{
    json_key(j, key);
    fputc('{', j->file);
    j->depth++;
    j->count = 0;
}

static inline void json_end(json *j)
{
    j->depth--;
    j->count = 1;
    fprintf(j->file, "\n%*s}", 2 * j->depth, "");
}

/* JSON has no NaN and no infinity: they become null. */
static inline void json_value(json *j, double value)
{
    if (value >= -1e300 && value <= 1e300) {
        fprintf(j->file, "%.9g", value);
    } else {
        fputs("null", j->file);
    }
}

static inline void json_number(json *j, const char *key, double value)
{
    json_key(j, key);
    json_value(j, value);
}

static inline void json_count(json *j, const char *key, unsigned long long value)
{
    json_key(j, key);
    fprintf(j->file, "%llu", value);
}

static inline void json_null(json *j, const char *key)
{
    json_key(j, key);
    fputs("null", j->file);
}

static inline void json_floats(json *j, const char *key, size_t n, const float *values)
{
    json_key(j, key);
    for (size_t i = 0; i < n; i++) {
        fputs(i ? ", " : "[", j->file);
        json_value(j, (double)values[i]);
    }
    fputs(n ? "]" : "[]", j->file);
}

static inline void json_text(json *j, const char *key, const char *text)
{
    json_key(j, key);
    fputc('"', j->file);
    for (const char *at = text; *at; at++) {
        unsigned char c = (unsigned char)*at;
        if (c == '"' || c == '\\') {
            fprintf(j->file, "\\%c", c);
        } else if (c < 32) {
            fprintf(j->file, "\\u%04x", c);
        } else if (c < 128) {
            fputc(c, j->file);
        } else { /* as it stands if it is UTF-8, else as Latin 1 */
            int more = c >= 0xf0 && c < 0xf5 ? 3 : c >= 0xe0 && c < 0xf0 ? 2 : c >= 0xc2 && c < 0xe0 ? 1 : 0;
            int good = more > 0;
            for (int i = 1; i <= more && good; i++) { good = ((unsigned char)at[i] & 0xc0) == 0x80; }
            if (!good) {
                fprintf(j->file, "\\u%04x", c);
                continue;
            }
            fwrite(at, 1, (size_t)more + 1, j->file);
            at += more;
        }
    }
    fputc('"', j->file);
}

/* Sums the counts; what bounds something keeps its worst. */
static inline void add_stats(dist_stats *sum, const dist_stats *s)
{
    sum->rays += s->rays;
    sum->rays_in_sphere += s->rays_in_sphere;
    sum->queries += s->queries;
    sum->cone_queries += s->cone_queries;
    sum->march_queries += s->march_queries;
    sum->refine_queries += s->refine_queries;
    sum->silhouette_queries += s->silhouette_queries;
    sum->normal_queries += s->normal_queries;
    sum->color_queries += s->color_queries;
    sum->hits += s->hits;
    sum->unresolved += s->unresolved;
    sum->inside += s->inside;
    sum->plateau += s->plateau;
    sum->not_finite += s->not_finite;
    sum->capped += s->capped;
    sum->backward_points += s->backward_points;
    sum->skipped += s->skipped;
    sum->operations += s->operations;
    sum->operations_done += s->operations_done;
    sum->epsilon = sum->epsilon > 0.0f && sum->epsilon < s->epsilon ? sum->epsilon : s->epsilon;
    sum->lipschitz = sum->lipschitz > s->lipschitz ? sum->lipschitz : s->lipschitz;
    sum->steepest = sum->steepest > s->steepest ? sum->steepest : s->steepest;
    sum->error = sum->error > s->error ? sum->error : s->error;
}

static inline void json_stats(json *j, const char *key, const dist_stats *s)
{
    json_begin(j, key);
    json_count(j, "rays", s->rays);
    json_count(j, "rays_in_sphere", s->rays_in_sphere);
    json_count(j, "queries", s->queries);
    json_count(j, "cone_queries", s->cone_queries);
    json_count(j, "march_queries", s->march_queries);
    json_count(j, "refine_queries", s->refine_queries);
    json_count(j, "silhouette_queries", s->silhouette_queries);
    json_count(j, "normal_queries", s->normal_queries);
    json_count(j, "color_queries", s->color_queries);
    json_count(j, "hits", s->hits);
    json_count(j, "unresolved", s->unresolved);
    json_count(j, "inside", s->inside);
    json_count(j, "plateau", s->plateau);
    json_count(j, "not_finite", s->not_finite);
    json_count(j, "capped", s->capped);
    json_count(j, "backward_points", s->backward_points);
    json_count(j, "skipped", s->skipped);
    json_number(j, "operations", s->operations);
    json_number(j, "operations_done", s->operations_done);
    json_number(j, "epsilon", (double)s->epsilon);
    json_number(j, "lipschitz", (double)s->lipschitz);
    json_number(j, "steepest", (double)s->steepest);
    json_number(j, "error", (double)s->error);
    json_end(j);
}

/* ---- model, code, camera ----------------------------------------------------------------------------------------- */

/* A safetensors file from its little-endian words. */
static inline dist_net *load_words(dist_context *ctx, size_t size, const unsigned *words)
{
    unsigned char *bytes = (unsigned char *)take(size, 1);
    for (size_t i = 0; i < size; i++) {
        bytes[i] = (unsigned char)(words[i / 4] >> (8 * (i % 4)) & 255u);
    }
    dist_net *net = dist_net_load(ctx, bytes, size);
    free(bytes);
    return net;
}

/* The model in examples/model.h. */
static inline dist_net *load_embedded(dist_context *ctx)
{
#ifdef COMMON_MODEL
    return load_words(ctx, (size_t)model_bytes, model_words);
#else
    (void)ctx;
    fail("this program was compiled without examples/model.h, so it has no embedded model");
    return NULL;
#endif
}

/* The texture for it in examples/model_color.h, or one from a file: rgb = g(shape code, color code, point). Row i of its
   codes is the code of shape 4 i, then coloring i, which goes with every shape. */
static inline dist_net *load_texture(dist_context *ctx, const char *texture)
{
    dist_net *net = NULL;
    if (strcmp(texture, "embedded") != 0) {
        net = dist_net_load_file(ctx, texture);
    } else {
#ifdef COMMON_MODEL_COLOR
        net = load_words(ctx, (size_t)texture_bytes, texture_words);
#else
        fail("this program was compiled without examples/model_color.h, so it has no embedded texture");
#endif
    }
    check(ctx);
    if (!net) { fail("%s cannot be loaded", texture); }
    return net;
}

/* A file, or "embedded". Never NULL. */
static inline dist_net *load_model(dist_context *ctx, const char *model)
{
    dist_net *net = strcmp(model, "embedded") == 0 ? load_embedded(ctx) : dist_net_load_file(ctx, model);
    check(ctx);
    if (!net) { fail("%s cannot be loaded", model); }
    return net;
}

/* A code from a file: raw little-endian floats if its name ends with .f32, else text. */
static inline void read_code(const char *path, size_t n, float *code)
{
    size_t size = 0;
    unsigned char *bytes = read_file(path, &size);
    if (path_ends_with(path, ".f32")) {
        if (size != 4 * n) {
            fail("%s has %.0f bytes; the model's code needs %.0f", path, (double)size, 4.0 * (double)n);
        }
        for (size_t i = 0; i < n; i++) {
            const unsigned char *b = bytes + 4 * i;
            unsigned bits = (unsigned)b[0] | (unsigned)b[1] << 8 | (unsigned)b[2] << 16 | (unsigned)b[3] << 24;
            memcpy(&code[i], &bits, 4);
        }
    } else {
        char *at = (char *)bytes;
        for (size_t i = 0; i <= n; i++) {
            at += strspn(at, " \t\r\n,;[]");
            char *end = at;
            double value = strtod(at, &end);
            if (i == n && !*at) { break; }
            if (i == n || end == at) { fail("%s must hold %.0f numbers, the model's code", path, (double)n); }
            code[i] = (float)value;
            at = end;
        }
    }
    for (size_t i = 0; i < n; i++) {
        if (!(code[i] >= -1e6f && code[i] <= 1e6f)) { fail("%s: number %.0f is not a sensible code", path, (double)i); }
    }
    free(bytes);
}

/* The average of the stored codes and, returned, their root mean square. */
static inline float mean_code(const dist_net *net, float *code)
{
    int n = dist_net_code_size(net);
    int count = dist_net_code_count(net);
    double squares = 0;
    memset(code, 0, (size_t)n * sizeof *code);
    for (int k = 0; k < count; k++) {
        const float *stored = dist_net_code(net, k);
        for (int i = 0; i < n; i++) {
            code[i] += stored[i] / (float)count;
            squares += (double)stored[i] * (double)stored[i];
        }
    }
    return count && n ? (float)sqrt(squares / count / n) : 0.01f;
}

/* text: an INDEX of a stored code, "zero", "mean", "random:SEED", or a FILE; NULL: the first stored code, or zeros.
   dist_net_code_size numbers (at least one is allocated); give them back with free. */
static inline float *choose_code(const dist_net *net, const char *text)
{
    int n = dist_net_code_size(net);
    int count = dist_net_code_count(net);
    float *code = take_floats((size_t)n);
    if (!text && count == 0) { return code; }
    if (!text) { text = "0"; }
    if (n == 0) { fail("the model has no code, so \"%s\" cannot be chosen", text); }
    if (strcmp(text, "zero") == 0) { return code; }
    if (strcmp(text, "mean") == 0) {
        if (count == 0) { fail("the model stores no codes, so there is no mean"); }
        mean_code(net, code);
        return code;
    }
    if (strncmp(text, "random:", 7) == 0) {
        if (!text[7] || text[7 + strspn(text + 7, "0123456789")]) { fail("\"%s\" must be random:SEED", text); }
        rng r = rng_begin(strtoull(text + 7, NULL, 10));
        float spread = mean_code(net, code);
        for (int i = 0; i < n; i++) {
            code[i] = spread * rng_normal(&r);
        }
        return code;
    }
    if (!text[strspn(text, "0123456789")]) {
        if (count == 0) { fail("code %s asked for, but the model stores none; a FILE can hold one", text); }
        long index = strtol(text, NULL, 10);
        if (index >= count) { fail("code %s asked for; the model stores %d, counted from 0", text, count); }
        memcpy(code, dist_net_code(net, (int)index), (size_t)n * sizeof *code);
        return code;
    }
    if (text[strspn(text, "+-.0123456789")] == 0) {
        if (count == 0) { fail("\"%s\" is no file, and the model stores no codes", text); }
        fail("\"%s\" is neither one of the model's codes, 0 to %d, nor a file", text, count - 1);
    }
    FILE *file = fopen(text, "rb");
    if (!file) { fail("\"%s\" is no INDEX, not \"zero\", \"mean\" or \"random:SEED\", and no file to be read", text); }
    fclose(file);
    read_code(text, (size_t)n, code);
    return code;
}

/* Where the picture is taken from: --size, --eye, --at, --fov. */
typedef struct view {
    int width, height;
    float eye[3], at[3], fov; /* fov: degrees, from top to bottom */
} view;

#define VIEW_USAGE                                                                 \
    "  --size WxH         picture in pixels\n"                                     \
    "  --eye X,Y,Z        camera's place (default 2.4 * (1.4, 1, 2) normalized)\n" \
    "  --at X,Y,Z         what it looks at (default 0,0,0)\n"                      \
    "  --fov DEGREES      field of view from top to bottom (default 50)\n"

static inline view view_default(int width, int height)
{
    float length = sqrtf(1.4f * 1.4f + 1.0f + 4.0f);
    view v;
    memset(&v, 0, sizeof v);
    v.width = width;
    v.height = height;
    v.eye[0] = 2.4f * 1.4f / length;
    v.eye[1] = 2.4f / length;
    v.eye[2] = 2.4f * 2.0f / length;
    v.fov = 50.0f;
    return v;
}

/* 1 if the option was one of the view's. */
static inline int option_view(options *o, view *v)
{
    if (option_is(o, "--size")) {
        option_size(o, &v->width, &v->height);
    } else if (option_is(o, "--eye")) {
        option_floats(o, 3, v->eye);
    } else if (option_is(o, "--at")) {
        option_floats(o, 3, v->at);
    } else if (option_is(o, "--fov")) {
        v->fov = (float)option_number(o, 0.1, 175.0);
    } else {
        return 0;
    }
    return 1;
}

/* turn: radians around the vertical axis through `at`. */
static inline dist_camera view_camera(const view *v, float turn)
{
    float up[3] = {0.0f, 1.0f, 0.0f};
    float x = v->eye[0] - v->at[0];
    float z = v->eye[2] - v->at[2];
    float eye[3];
    eye[0] = v->at[0] + cosf(turn) * x + sinf(turn) * z;
    eye[1] = v->eye[1];
    eye[2] = v->at[2] - sinf(turn) * x + cosf(turn) * z;
    if (eye[0] == v->at[0] && eye[1] == v->at[1] && eye[2] == v->at[2]) { fail("--eye and --at are the same point"); }
    return dist_camera_look_at(v->width, v->height, v->fov * PI / 180.0f, eye, v->at, up);
}

static inline void json_camera(json *j, const char *key, const dist_camera *camera)
{
    json_begin(j, key);
    json_count(j, "width", (unsigned long long)camera->width);
    json_count(j, "height", (unsigned long long)camera->height);
    json_number(j, "fx", (double)camera->fx);
    json_number(j, "fy", (double)camera->fy);
    json_number(j, "cx", (double)camera->cx);
    json_number(j, "cy", (double)camera->cy);
    json_number(j, "skew", (double)camera->skew);
    json_number(j, "pixel_center", (double)camera->pixel_center);
    json_floats(j, "rotation", 9, camera->rotation);
    json_floats(j, "translation", 3, camera->translation);
    json_end(j);
}

/* ---- pictures ---------------------------------------------------------------------------------------------------- */

typedef struct canvas {
    int width, height;
    unsigned char *rgb;
} canvas;

static inline canvas canvas_create(int width, int height, float gray)
{
    canvas c;
    c.width = width;
    c.height = height;
    c.rgb = (unsigned char *)take((size_t)width * (size_t)height, 3);
    memset(c.rgb, (int)(gray * 255.0f), (size_t)width * (size_t)height * 3);
    return c;
}

static inline void canvas_destroy(canvas *c)
{
    free(c->rgb);
    c->rgb = NULL;
}

/* Colors are 0 to 1; what lies outside is cut. */
static inline void canvas_set(canvas *c, int x, int y, float r, float g, float b)
{
    if (x < 0 || y < 0 || x >= c->width || y >= c->height) { return; }
    unsigned char *p = c->rgb + 3 * ((size_t)y * (size_t)c->width + (size_t)x);
    p[0] = (unsigned char)(255.0f * (r < 0 ? 0 : r > 1 ? 1 : r) + 0.5f);
    p[1] = (unsigned char)(255.0f * (g < 0 ? 0 : g > 1 ? 1 : g) + 0.5f);
    p[2] = (unsigned char)(255.0f * (b < 0 ? 0 : b > 1 ? 1 : b) + 0.5f);
}

/* Places a picture, each of its pixels as a square of `scale`. */
static inline void canvas_place(canvas *to, const canvas *from, int left, int top, int scale)
{
    for (int y = 0; y < from->height * scale; y++) {
        for (int x = 0; x < from->width * scale; x++) {
            const unsigned char *p = from->rgb + 3 * ((size_t)(y / scale) * (size_t)from->width + (size_t)(x / scale));
            if (left + x < 0 || top + y < 0 || left + x >= to->width || top + y >= to->height) { continue; }
            memcpy(to->rgb + 3 * ((size_t)(top + y) * (size_t)to->width + (size_t)(left + x)), p, 3);
        }
    }
}

/* Capitals, digits and a few signs, five by seven: one byte a row, the leftmost pixel is 16. */
static inline const unsigned char *glyph_rows(char letter)
{
    static const char letters[] = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ.,-+%:/()=";
    static const unsigned char rows[][7] = {
        {14, 17, 19, 21, 25, 17, 14}, {4, 12, 4, 4, 4, 4, 14},      {14, 17, 1, 2, 4, 8, 31},
        {31, 2, 4, 2, 1, 17, 14},     {2, 6, 10, 18, 31, 2, 2},     {31, 16, 30, 1, 1, 17, 14},
        {6, 8, 16, 30, 17, 17, 14},   {31, 1, 2, 4, 8, 8, 8},       {14, 17, 17, 14, 17, 17, 14},
        {14, 17, 17, 15, 1, 2, 12},   {14, 17, 17, 31, 17, 17, 17}, {30, 17, 17, 30, 17, 17, 30},
        {14, 17, 16, 16, 16, 17, 14}, {30, 17, 17, 17, 17, 17, 30}, {31, 16, 16, 30, 16, 16, 31},
        {31, 16, 16, 30, 16, 16, 16}, {14, 17, 16, 23, 17, 17, 15}, {17, 17, 17, 31, 17, 17, 17},
        {14, 4, 4, 4, 4, 4, 14},      {7, 2, 2, 2, 2, 18, 12},      {17, 18, 20, 24, 20, 18, 17},
        {16, 16, 16, 16, 16, 16, 31}, {17, 27, 21, 21, 17, 17, 17}, {17, 25, 21, 19, 17, 17, 17},
        {14, 17, 17, 17, 17, 17, 14}, {30, 17, 17, 30, 16, 16, 16}, {14, 17, 17, 17, 21, 18, 13},
        {30, 17, 17, 30, 20, 18, 17}, {15, 16, 16, 14, 1, 1, 30},   {31, 4, 4, 4, 4, 4, 4},
        {17, 17, 17, 17, 17, 17, 14}, {17, 17, 17, 17, 17, 10, 4},  {17, 17, 17, 21, 21, 27, 17},
        {17, 17, 10, 4, 10, 17, 17},  {17, 17, 10, 4, 4, 4, 4},     {31, 1, 2, 4, 8, 16, 31},
        {0, 0, 0, 0, 0, 12, 12},      {0, 0, 0, 0, 12, 4, 8},       {0, 0, 0, 31, 0, 0, 0},
        {0, 4, 4, 31, 4, 4, 0},       {24, 25, 2, 4, 8, 19, 3},     {0, 12, 12, 0, 12, 12, 0},
        {1, 1, 2, 4, 8, 16, 16},      {2, 4, 8, 8, 8, 4, 2},        {8, 4, 2, 2, 2, 4, 8},
        {0, 0, 31, 0, 31, 0, 0}};
    static const unsigned char blank[7] = {0, 0, 0, 0, 0, 0, 0};
    if (letter >= 'a' && letter <= 'z') { letter = (char)(letter - 'a' + 'A'); }
    const char *found = letter ? strchr(letters, letter) : NULL;
    return found ? rows[found - letters] : blank;
}

static inline void canvas_text(canvas *c, int left, int top, int scale, float gray, const char *text)
{
    for (int k = 0; text[k]; k++) {
        const unsigned char *rows = glyph_rows(text[k]);
        for (int i = 0; i < 35 * scale * scale; i++) {
            int x = i % (5 * scale);
            int y = i / (5 * scale);
            if (rows[y / scale] >> (4 - x / scale) & 1) {
                canvas_set(c, left + 6 * scale * k + x, top + y, gray, gray, gray);
            }
        }
    }
}

/* A perceptual color map as one polynomial of degree six a channel; t from 0 to 1. */
static inline void color_map(const float table[3][7], float t, float rgb[3])
{
    t = t < 0 ? 0 : t > 1 ? 1 : t;
    for (int c = 0; c < 3; c++) {
        rgb[c] = 0;
        for (int k = 6; k >= 0; k--) {
            rgb[c] = rgb[c] * t + table[c][k];
        }
    }
}

/* Dark blue to yellow: for quantities. */
static inline void color_viridis(float t, float rgb[3])
{
    static const float table[3][7] = {{0.2777f, 0.1051f, -0.3309f, -4.6342f, 6.2283f, 4.7764f, -5.4355f},
                                      {0.0054f, 1.4046f, 0.2148f, -5.7991f, 14.1799f, -13.7451f, 4.6459f},
                                      {0.3341f, 1.3846f, 0.0951f, -19.3324f, 56.6906f, -65.3530f, 26.3124f}};
    color_map(table, t, rgb);
}

/* Black to light yellow: for errors. */
static inline void color_inferno(float t, float rgb[3])
{
    static const float table[3][7] = {{0.0002f, 0.1065f, 11.6025f, -41.7040f, 77.1629f, -71.3194f, 25.1311f},
                                      {0.0017f, 0.5640f, -3.9729f, 17.4364f, -33.4024f, 32.6261f, -12.2427f},
                                      {-0.0195f, 3.9327f, -15.9424f, 44.3542f, -81.8073f, 73.2095f, -23.0703f}};
    color_map(table, t, rgb);
}

/* A soft gray that is a little lighter above: what lies behind the shapes. */
static inline void paint_background(canvas *c)
{
    for (int y = 0; y < c->height; y++) {
        float light = 0.95f - 0.13f * (float)y / (float)c->height;
        for (int x = 0; x < c->width; x++) {
            canvas_set(c, x, y, light, light, light + 0.01f);
        }
    }
}

/* Depth between near and far in false colors, near ones bright; a miss is left as the background. */
static inline canvas picture_depth(int width, int height, const float *depth, const unsigned char *mask,
                                   float near_depth, float far_depth)
{
    canvas c = canvas_create(width, height, 0.0f);
    float range = far_depth > near_depth ? far_depth - near_depth : 1.0f;
    paint_background(&c);
    for (int i = 0; i < width * height; i++) {
        float rgb[3];
        if (!mask[i]) { continue; }
        color_viridis(1.0f - 0.95f * (depth[i] - near_depth) / range, rgb);
        canvas_set(&c, i % width, i / width, rgb[0], rgb[1], rgb[2]);
    }
    return c;
}

/* Smallest and largest depth of the hits; 0 and 1 if there are none. */
static inline void depth_range(size_t n, const float *depth, const unsigned char *mask, float range[2])
{
    range[0] = 1e30f;
    range[1] = -1e30f;
    for (size_t i = 0; i < n; i++) {
        if (!mask[i]) { continue; }
        range[0] = depth[i] < range[0] ? depth[i] : range[0];
        range[1] = depth[i] > range[1] ? depth[i] : range[1];
    }
    if (range[0] > range[1]) {
        range[0] = 0.0f;
        range[1] = 1.0f;
    }
}

/* Normals in camera space (x right, y down, z forward) as the usual light blue picture. */
static inline canvas picture_normal(int width, int height, const float *normal, const unsigned char *mask)
{
    canvas c = canvas_create(width, height, 0.0f);
    for (int i = 0; i < width * height; i++) {
        const float *n = normal + 3 * i;
        if (mask[i]) {
            canvas_set(&c, i % width, i / width, 0.5f + 0.5f * n[0], 0.5f - 0.5f * n[1], 0.5f - 0.5f * n[2]);
        }
    }
    return c;
}

/* Clay under a lamp beside the camera. color (h, w, 3) in place of the clay's, or NULL. */
static inline canvas picture_shaded(int width, int height, const float *normal, const unsigned char *mask,
                                    const float *color)
{
    canvas c = canvas_create(width, height, 0.0f);
    paint_background(&c);
    for (int i = 0; i < width * height; i++) {
        const float *n = normal + 3 * i;
        if (!mask[i]) { continue; }
        float lamp = -0.40f * n[0] - 0.55f * n[1] - 0.73f * n[2];
        float front = -n[2] < 0.0f ? 0.0f : -n[2];
        float sky = 0.5f - 0.5f * n[1];
        float light = 0.16f + 0.20f * sky + 0.24f * front + 0.46f * (lamp > 0.0f ? lamp : 0.0f);
        float r = color ? color[3 * i] : 0.90f;
        float g = color ? color[3 * i + 1] : 0.84f;
        float b = color ? color[3 * i + 2] : 0.77f;
        canvas_set(&c, i % width, i / width, light * r, light * g, light * b);
    }
    return c;
}

/* Values from low to high as gray. */
static inline canvas picture_gray(int width, int height, const float *value, float low, float high)
{
    canvas c = canvas_create(width, height, 0.0f);
    for (int i = 0; i < width * height; i++) {
        float t = (value[i] - low) / (high > low ? high - low : 1.0f);
        canvas_set(&c, i % width, i / width, t, t, t);
    }
    return c;
}

static inline canvas picture_mask(int width, int height, const unsigned char *mask)
{
    canvas c = canvas_create(width, height, 0.0f);
    for (int i = 0; i < width * height; i++) {
        if (mask[i]) { canvas_set(&c, i % width, i / width, 1.0f, 1.0f, 1.0f); }
    }
    return c;
}

/* Colors from 0 to 1 as they are. */
static inline canvas picture_color(int width, int height, const float *color)
{
    canvas c = canvas_create(width, height, 0.0f);
    for (int i = 0; i < width * height; i++) {
        canvas_set(&c, i % width, i / width, color[3 * i], color[3 * i + 1], color[3 * i + 2]);
    }
    return c;
}

/* |a - b| where both are hit, 0 to largest, from black to yellow; pixels that only one of them hits are blue. */
static inline canvas picture_error(int width, int height, const float *a, const unsigned char *mask_a, const float *b,
                                   const unsigned char *mask_b, float largest)
{
    canvas c = canvas_create(width, height, 0.0f);
    paint_background(&c);
    for (int i = 0; i < width * height; i++) {
        float rgb[3] = {0.25f, 0.45f, 0.85f};
        if (!mask_a[i] && !mask_b[i]) { continue; }
        if (mask_a[i] && mask_b[i]) { color_inferno(fabsf(a[i] - b[i]) / largest, rgb); }
        canvas_set(&c, i % width, i / width, rgb[0], rgb[1], rgb[2]);
    }
    return c;
}

/* Replaces a picture by a larger one, each pixel a square. */
static inline void canvas_enlarge(canvas *c, int scale)
{
    canvas larger = canvas_create(c->width * scale, c->height * scale, 0.0f);
    canvas_place(&larger, c, 0, 0, scale);
    canvas_destroy(c);
    *c = larger;
}

/* By how much a small picture must grow to be looked at with pleasure: to about 256 pixels. */
static inline int picture_zoom(int width, int height)
{
    int largest = width > height ? width : height;
    return largest >= 200 ? 1 : (256 + largest / 2) / largest;
}

/* A picture with each square of `scale` pixels averaged to one: the end of anti-aliasing. */
static inline void canvas_reduce(canvas *c, int scale)
{
    canvas smaller = canvas_create(c->width / scale, c->height / scale, 0.0f);
    size_t width = (size_t)smaller.width, side = (size_t)scale;
    for (size_t i = 0; i < 3 * width * (size_t)smaller.height; i++) {
        size_t sum = side * side / 2, x = i / 3 % width * side, y = i / 3 / width * side;
        for (size_t k = 0; k < side * side; k++)
            sum += c->rgb[3 * ((y + k / side) * (size_t)c->width + x + k % side) + i % 3];
        smaller.rgb[i] = (unsigned char)(sum / (side * side));
    }
    canvas_destroy(c);
    *c = smaller;
}

/* The same view in a picture `zoom` times as large. */
static inline dist_camera zoom_camera(const dist_camera *camera, int zoom)
{
    dist_camera c = *camera;
    float k = (float)zoom;
    c.width *= zoom;
    c.height *= zoom;
    c.fx *= k;
    c.fy *= k;
    c.skew *= k;
    c.cx = (c.cx - c.pixel_center + 0.5f) * k - 0.5f + c.pixel_center;
    c.cy = (c.cy - c.pixel_center + 0.5f) * k - 0.5f + c.pixel_center;
    return c;
}

/* Pictures of one size, `columns` in a row, with captions below (captions may be NULL). */
static inline canvas picture_sheet(int count, const canvas *pictures, const char *const *captions, int columns)
{
    int w = pictures[0].width;
    int h = pictures[0].height;
    int gap = 6;
    size_t longest = 1;
    for (int i = 0; captions && i < count; i++) {
        longest = strlen(captions[i]) > longest ? strlen(captions[i]) : longest;
    }
    int letter = w / (6 * (int)longest);
    letter = letter < 1 ? 1 : letter > 2 ? 2 : letter;
    int row = h + gap + (captions ? 7 * letter + 2 * gap : 0);
    int rows = (count + columns - 1) / columns;
    canvas sheet = canvas_create(columns * (w + gap) + gap, rows * row + gap, 1.0f);
    for (int i = 0; i < count; i++) {
        int left = gap + i % columns * (w + gap);
        int top = gap + i / columns * row;
        canvas_place(&sheet, &pictures[i], left, top, 1);
        if (!captions) { continue; }
        int room = w - 6 * letter * (int)strlen(captions[i]);
        canvas_text(&sheet, left + (room > 0 ? room / 2 : 0), top + h + gap, letter, 0.15f, captions[i]);
    }
    return sheet;
}

#ifdef COMMON_STB
/* stb_image_write's own file functions do not tell when a disk is full; close_file does. */
static inline void write_bytes(void *file, void *bytes, int size)
{
    fwrite(bytes, 1, (size_t)size, (FILE *)file);
}
#endif

/* Writes STEM.png, or STEM.ppm in a build without stb_image_write.h. Returns the name, good until the next call. */
static inline const char *write_picture(const char *stem, int width, int height, const unsigned char *rgb)
{
    static char path[PATH_SIZE];
#ifdef COMMON_STB
    if ((3.0 * width + 1.0) * height > 2147483647.0) { /* stb_image_write counts in int */
        fail("%s.png would have %d by %d pixels, more than 2 GB", stem, width, height);
    }
    FILE *file = open_file(path_of(path, stem, ".png"), "wb");
    if (!stbi_write_png_to_func(write_bytes, file, width, height, 3, rgb, 3 * width)) {
        fail("out of memory while %s is written", path);
    }
    close_file(file, path);
#else
    static int told = 0;
    FILE *file = open_file(path_of(path, stem, ".ppm"), "wb");
    fprintf(file, "P6\n%d %d\n255\n", width, height);
    fwrite(rgb, 3, (size_t)width * (size_t)height, file);
    close_file(file, path);
    if (!told++) { puts("pictures are PPM: stb_image_write.h (package libstb-dev) was not found at compile time"); }
#endif
    return path;
}

/* Writes a picture and ends it. */
static inline const char *write_canvas(const char *stem, canvas *c)
{
    const char *path = write_picture(stem, c->width, c->height, c->rgb);
    canvas_destroy(c);
    return path;
}

/* ---- error and cost ---------------------------------------------------------------------------------------------- */

/* Bytes that a context and all that belongs to it hold at present: settings.allocator = counting_allocator(&bytes).
   Each piece has its block's address before it. */
static inline void *counting_alloc(void *user, size_t bytes, size_t alignment)
{
    size_t room = alignment + sizeof(void *);
    char *block = bytes < (size_t)-1 - room ? (char *)malloc(bytes + room) : NULL;
    if (!block) { return NULL; }
    char *piece = block + room - (size_t)(block + room) % alignment;
    memcpy(piece - sizeof block, &block, sizeof block);
    *(size_t *)user += bytes;
    return piece;
}

static inline void counting_free(void *user, void *pointer, size_t bytes)
{
    char *block;
    memcpy(&block, (char *)pointer - sizeof block, sizeof block);
    *(size_t *)user -= bytes;
    free(block);
}

static inline dist_allocator counting_allocator(size_t *bytes)
{
    dist_allocator a = {bytes, counting_alloc, counting_free};
    return a;
}

static inline int compare_floats(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

/* Median and 99th percentile (nearest rank) and largest of n values, which are sorted; -1 of none. */
static inline void spread_of(size_t n, float *values, double spread[3])
{
    spread[0] = spread[1] = spread[2] = -1;
    if (n == 0) { return; }
    qsort(values, n, sizeof *values, compare_floats);
    spread[0] = (double)values[(n + 1) / 2 - 1];
    spread[1] = (double)values[(n * 99 + 99) / 100 - 1];
    spread[2] = (double)values[n - 1];
}

/* One half of a line; below 0: not known. */
static inline void print_cell(const char *name, double value)
{
    printf("  %-22s", name);
    if (value < 0) printf("%14s", "none");
    else if (value < 1e13 && floor(value) >= value) printf("%14.0f", value);
    else printf("%14.4g", value);
}

#define REPORT_USAGE                                                                                      \
    "  --report           prints error and cost: the hits' error bounds and true errors along the ray, by a\n" \
    "                     certified picture with epsilon 1e-7; queries by phase, seconds, the library's bytes\n"

/* Error and cost of a picture side by side. picture: its distance, error, mask and stats. The truth is rendered anew:
   same camera and field, certified, epsilon 1e-7, with a larger Lipschitz figure where it meets such slopes; a hole is a
   hit of its alone, a false hit a miss of its. */
static inline void print_report(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                                const dist_render_desc *how, const dist_images *picture, double seconds, size_t bytes)
{
    static const char *const names[2][14] = {
        {"hits", "unresolved", "bound, median", "bound, p99", "bound, largest", "true error, median",
         "true error, p99", "true error, largest", "share within bound", "holes", "false hits", "truth: unresolved",
         "truth: queries", "slope reckoned with"},
        {"queries", "  cones", "  march", "  refine", "  silhouette", "  normals", "  colors", "queries a pixel",
         "queries a hit", "multiply-adds asked", "multiply-adds done", "seconds", "bytes of memory", "slope of the truth"}};
    size_t n = (size_t)camera->width * (size_t)camera->height;
    size_t hits = 0, both = 0, within = 0, holes = 0, false_hits = 0;
    const dist_stats *s = picture->stats;
    float *bounds = take_floats(n), *errors = take_floats(n);
    double bound[3], error[3];
    dist_render_desc exact = *how;
    dist_images truth;
    dist_stats spent;
    memset(&truth, 0, sizeof truth);
    truth.distance = take_floats(n);
    truth.status = (unsigned char *)take(n, 1);
    truth.stats = &spent;
    exact.trace = DIST_TRACE_GUARDED;
    exact.certified = 1;
    exact.epsilon = 1e-7f;
    exact.step_scale = 0.0f;
    exact.max_steps = exact.warm_start = 0;
    exact.max_queries = 0;
    for (int round = 0; round < 5; round++) { /* until no steeper slope is met than was reckoned with */
        dist_render(ctx, field, camera, &exact, &truth, NULL);
        check(ctx);
        if (!(spent.steepest > 0)) { break; }
        exact.lipschitz = 1.2f * spent.steepest;
    }
    for (size_t i = 0; i < n; i++) {
        int there = truth.status[i] == DIST_RAY_HIT;
        holes += there && !picture->mask[i];
        if (!picture->mask[i]) { continue; }
        bounds[hits++] = picture->error[i];
        false_hits += truth.status[i] == DIST_RAY_MISS;
        if (!there) { continue; }
        errors[both] = fabsf(picture->distance[i] - truth.distance[i]);
        within += errors[both++] <= picture->error[i];
    }
    spread_of(hits, bounds, bound);
    spread_of(both, errors, error);
    double queries = (double)s->queries;
    double values[2][14] = {
        {(double)hits, (double)s->unresolved, bound[0], bound[1], bound[2], error[0], error[1], error[2],
         both ? (double)within / (double)both : -1, (double)holes, (double)false_hits, (double)spent.unresolved,
         (double)spent.queries, (double)s->lipschitz},
        {queries, (double)s->cone_queries, (double)s->march_queries, (double)s->refine_queries,
         (double)s->silhouette_queries, (double)s->normal_queries, (double)s->color_queries, queries / (double)n,
         hits ? queries / (double)hits : -1, s->operations, s->operations_done, seconds, (double)bytes,
         (double)spent.lipschitz}};
    printf("  %-36s    %s\n", "error", "cost");
    for (int i = 0; i < 14; i++) {
        print_cell(names[0][i], values[0][i]);
        print_cell(names[1][i], values[1][i]);
        putchar('\n');
    }
    if (spent.steepest > 0) puts("The truth met steeper slopes than it reckoned with, so it is no proof.");
    free(bounds);
    free(errors);
    free(truth.distance);
    free(truth.status);
}

/* ---- curves ------------------------------------------------------------------------------------------------------ */

typedef struct curve {
    const char *name;
    size_t n;
    const double *x; /* NULL: 0, 1, 2 ... */
    const double *y;
} curve;

/* A round step that gives about five ticks over the range. */
static inline double tick_step(double range)
{
    double power = pow(10.0, floor(log10(range / 5.0)));
    double rest = range / 5.0 / power;
    return power * (rest < 1.5 ? 1.0 : rest < 3.5 ? 2.0 : rest < 7.5 ? 5.0 : 10.0);
}

/* Lowest and highest of what is drawn: x in range[0..1], y in range[2..3]. On a log axis y is the power of ten, and
   what lies more than five of them below the top is drawn at the bottom. */
static inline void curve_range(size_t count, const curve *curves, int log_y, double range[4])
{
    range[0] = range[2] = 1e300;
    range[1] = range[3] = -1e300;
    for (size_t k = 0; k < count; k++) {
        for (size_t i = 0; i < curves[k].n; i++) {
            double x = curves[k].x ? curves[k].x[i] : (double)i;
            double y = curves[k].y[i];
            if (log_y && !(y > 0)) { continue; }
            y = log_y ? log10(y) : y;
            range[0] = x < range[0] ? x : range[0];
            range[1] = x > range[1] ? x : range[1];
            range[2] = y < range[2] ? y : range[2];
            range[3] = y > range[3] ? y : range[3];
        }
    }
    if (range[0] > range[1]) { range[0] = range[2] = 0, range[1] = range[3] = 1; }
    if (!log_y && range[2] > 0) { range[2] = 0; }
    if (log_y) { range[2] = floor(range[2]), range[3] = ceil(range[3]); }
    if (log_y && range[2] < range[3] - 5) { range[2] = range[3] - 5; }
    if (range[1] <= range[0]) { range[1] = range[0] + 1; }
    if (range[3] <= range[2]) { range[3] = range[2] + 1; }
}

#define SVG_X(v) (64.0 + 500.0 * ((v)-range[0]) / (range[1] - range[0]))
#define SVG_Y(v) (304.0 - 264.0 * ((v)-range[2]) / (range[3] - range[2]))

/* Grid lines, ticks and their numbers. */
static inline void svg_axes(FILE *f, const double range[4], int log_y)
{
    double step = tick_step(range[1] - range[0]);
    for (double x = ceil(range[0] / step - 1e-9) * step; x <= range[1] + 1e-9 * step; x += step) {
        fprintf(f, "<path d='M%.1f 40V304' stroke='#ddd'/><text x='%.1f' y='320' text-anchor='middle'>%.6g</text>\n",
                SVG_X(x), SVG_X(x), fabs(x) < 1e-9 * step ? 0 : x);
    }
    step = log_y ? 1 : tick_step(range[3] - range[2]);
    for (double y = ceil(range[2] / step - 1e-9) * step; y <= range[3] + 1e-9 * step; y += step) {
        fprintf(f, "<path d='M64 %.1fH564' stroke='#ddd'/><text x='58' y='%.1f' text-anchor='end'>%.6g</text>\n",
                SVG_Y(y), SVG_Y(y) + 4,
                log_y                   ? pow(10.0, y)
                : fabs(y) < 1e-9 * step ? 0
                                        : y);
    }
    fputs("<path d='M64 40V304H564' fill='none' stroke='#333'/>\n", f);
}

/* One or several curves over the same axes. Names must not hold <, > or &. */
static inline void write_curves(const char *path, const char *title, const char *x_label, const char *y_label,
                                size_t count, const curve *curves, int log_y)
{
    static const char *const colors[] = {"#0b6bb5", "#d1495b", "#2e8b57", "#8a5fbf", "#c98a00", "#444444"};
    double range[4];
    curve_range(count, curves, log_y, range);
    FILE *f = open_file(path, "wb");
    fputs("<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 600 350' width='600' height='350' "
          "font-family='sans-serif' font-size='12' fill='#333'>\n<rect width='600' height='350' fill='white'/>\n",
          f);
    svg_axes(f, range, log_y);
    fprintf(f, "<text x='314' y='24' text-anchor='middle' font-size='15'>%s</text>\n", title);
    fprintf(f, "<text x='314' y='342' text-anchor='middle'>%s</text>\n", x_label);
    fprintf(f, "<text transform='translate(14 172) rotate(-90)' text-anchor='middle'>%s</text>\n", y_label);
    for (size_t k = count; k-- > 0;) { /* the first one last, so that it is on top */
        fprintf(f, "<polyline fill='none' stroke='%s' stroke-width='1.8' points='", colors[k % 6]);
        for (size_t i = 0; i < curves[k].n; i++) {
            double x = curves[k].x ? curves[k].x[i] : (double)i;
            double y = curves[k].y[i];
            if (!(y >= -1e300 && y <= 1e300) || (log_y && !(y > 0))) { continue; }
            y = log_y ? log10(y) : y;
            fprintf(f, "%.1f,%.1f ", SVG_X(x), SVG_Y(y < range[2] ? range[2] : y));
        }
        fputs("'/>\n", f);
    }
    for (size_t k = 0; k < count; k++) {
        double row = 56.0 + 16.0 * (double)k;
        if (!curves[k].name) { continue; }
        fprintf(f, "<rect x='432' y='%.1f' width='132' height='16' fill='white' opacity='0.8'/>", row - 12);
        fprintf(f, "<path d='M440 %.1fh22' stroke='%s' stroke-width='2'/>", row - 4, colors[k % 6]);
        fprintf(f, "<text x='468' y='%.1f'>%s</text>\n", row, curves[k].name);
    }
    fputs("</svg>\n", f);
    close_file(f, path);
}
#undef SVG_X
#undef SVG_Y

#endif
