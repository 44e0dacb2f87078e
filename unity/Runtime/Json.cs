using System;
using System.Collections;
using System.Collections.Generic;
using System.Globalization;
using System.Text;

namespace CapSense
{
    /// <summary>Reads and writes the little JSON that control messages need.</summary>
    /// <remarks>
    /// Objects are <c>Dictionary&lt;string, object&gt;</c>, arrays <c>List&lt;object&gt;</c>, numbers
    /// <c>double</c>. Works without reflection, so also where code is compiled ahead of time.
    /// </remarks>
    public static class Json
    {
        private const int MaxDepth = 32;

        /// <summary>The value of a JSON text.</summary>
        /// <exception cref="FormatException">The text is not JSON.</exception>
        public static object Parse(string text)
        {
            int at = 0;
            object value = Value(text, ref at, 0);
            Skip(text, ref at);
            if (at != text.Length) throw Wrong(text, at);
            return value;
        }

        /// <summary>The JSON text of dictionaries, sequences, strings, numbers, booleans and null.</summary>
        public static string Write(object value)
        {
            var text = new StringBuilder();
            Write(text, value);
            return text.ToString();
        }

        private static object Value(string text, ref int at, int depth)
        {
            Skip(text, ref at);
            if (at >= text.Length || depth > MaxDepth) throw Wrong(text, at);
            switch (text[at])
            {
                case '{': return Object(text, ref at, depth);
                case '[': return Array(text, ref at, depth);
                case '"': return String(text, ref at);
                case 't': return Word(text, ref at, "true", true);
                case 'f': return Word(text, ref at, "false", false);
                case 'n': return Word(text, ref at, "null", null);
                default: return Number(text, ref at);
            }
        }

        private static object Object(string text, ref int at, int depth)
        {
            var found = new Dictionary<string, object>();
            at++;
            if (Follows(text, ref at, '}')) return found;
            do
            {
                Skip(text, ref at);
                if (at >= text.Length || text[at] != '"') throw Wrong(text, at);
                string key = String(text, ref at);
                if (!Follows(text, ref at, ':')) throw Wrong(text, at);
                found[key] = Value(text, ref at, depth + 1);
            }
            while (Follows(text, ref at, ','));
            if (!Follows(text, ref at, '}')) throw Wrong(text, at);
            return found;
        }

        private static object Array(string text, ref int at, int depth)
        {
            var found = new List<object>();
            at++;
            if (Follows(text, ref at, ']')) return found;
            do found.Add(Value(text, ref at, depth + 1));
            while (Follows(text, ref at, ','));
            if (!Follows(text, ref at, ']')) throw Wrong(text, at);
            return found;
        }

        private static string String(string text, ref int at)
        {
            var found = new StringBuilder();
            for (at++; at < text.Length; at++)
            {
                char c = text[at];
                if (c == '"') { at++; return found.ToString(); }
                if (c != '\\') { found.Append(c); continue; }
                if (++at >= text.Length) break;
                int plain = "\"\\/bfnrt".IndexOf(text[at]);
                if (plain >= 0) found.Append("\"\\/\b\f\n\r\t"[plain]);
                else if (text[at] == 'u' && at + 4 < text.Length
                    && ushort.TryParse(text.Substring(at + 1, 4), NumberStyles.AllowHexSpecifier,
                        CultureInfo.InvariantCulture, out ushort code))
                {
                    found.Append((char)code);
                    at += 4;
                }
                else throw Wrong(text, at);
            }
            throw Wrong(text, at);
        }

        private static object Word(string text, ref int at, string word, object value)
        {
            if (string.CompareOrdinal(text, at, word, 0, word.Length) != 0) throw Wrong(text, at);
            at += word.Length;
            return value;
        }

        private static object Number(string text, ref int at)
        {
            int start = at;
            while (at < text.Length && "+-.eE0123456789".IndexOf(text[at]) >= 0) at++;
            if (!double.TryParse(text.Substring(start, at - start), NumberStyles.Float,
                CultureInfo.InvariantCulture, out double value)) throw Wrong(text, start);
            return value;
        }

        private static bool Follows(string text, ref int at, char wanted)
        {
            Skip(text, ref at);
            if (at >= text.Length || text[at] != wanted) return false;
            at++;
            return true;
        }

        private static void Skip(string text, ref int at)
        {
            while (at < text.Length && " \t\r\n".IndexOf(text[at]) >= 0) at++;
        }

        private static FormatException Wrong(string text, int at)
        {
            return new FormatException("not JSON at character " + at + " of " + text.Length);
        }

        private static void Write(StringBuilder text, object value)
        {
            if (value == null) text.Append("null");
            else if (value is bool) text.Append((bool)value ? "true" : "false");
            else if (value is string) Quote(text, (string)value);
            else if (value is IDictionary<string, object>) WriteObject(text, (IDictionary<string, object>)value);
            else if (value is IEnumerable) WriteArray(text, (IEnumerable)value);
            else if (value is float) text.Append(((float)value).ToString("G9", CultureInfo.InvariantCulture));
            else if (value is double) text.Append(((double)value).ToString("G17", CultureInfo.InvariantCulture));
            else text.Append(Convert.ToString(value, CultureInfo.InvariantCulture));
        }

        private static void WriteObject(StringBuilder text, IDictionary<string, object> map)
        {
            text.Append('{');
            bool first = true;
            foreach (var pair in map)
            {
                if (!first) text.Append(',');
                first = false;
                Quote(text, pair.Key);
                text.Append(':');
                Write(text, pair.Value);
            }
            text.Append('}');
        }

        private static void WriteArray(StringBuilder text, IEnumerable list)
        {
            text.Append('[');
            bool first = true;
            foreach (object item in list)
            {
                if (!first) text.Append(',');
                first = false;
                Write(text, item);
            }
            text.Append(']');
        }

        private static void Quote(StringBuilder text, string value)
        {
            text.Append('"');
            foreach (char c in value)
            {
                if (c == '"' || c == '\\') text.Append('\\').Append(c);
                else if (c < ' ') text.Append("\\u").Append(((int)c).ToString("x4"));
                else text.Append(c);
            }
            text.Append('"');
        }
    }
}
